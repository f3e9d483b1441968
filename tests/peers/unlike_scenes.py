"""Scenes unlike those that the shipped checkpoint has learned from, as scene files of `eddy simulate --scene`.

    unlike_scenes.py OUTPUT --eddy EDDY [--seed 1] [--kinds-seed 1001]

Writes three folders to OUTPUT, which must not exist. No scene has the attractor that half of the scenes of `kinds` have:

- three_materials: ten scenes with a disc each of three of the four materials, in all 1,100 to 2,100 particles (`kinds`: one or two
  materials, 2,500 particles);
- dam_break: five columns of liquid, at rest first, that fill a third of the domain, some 4,450 particles;
- fast: the bodies of fifteen scenes of `kinds`, of another seed than that of the training, at 3 to 5 domain lengths per second
  (`kinds`: up to 1.5 along each axis).
"""

import argparse
import json
import math
import random
import subprocess
import tempfile
from pathlib import Path

MATERIALS = ("liquid", "snow", "jelly", "rope")
SPACING = 1 / 128
# The outermost three cells are walls.
WALL = 3 / 64
DURATION = 4.8


def number(value):
    """TOML of a number or of a list of them."""
    return f"[{', '.join(map(number, value))}]" if isinstance(value, list) else f"{value:.6g}"


def body(material, shape, position, velocity=(0.0, 0.0), angle=0.0):
    lines = ["[[bodies]]", f'material = "{material}"']
    kind, sizes = next(iter(shape.items()))
    lines += [f"shape.{kind}.{name} = {number(value)}" for name, value in sizes.items()]
    lines += [f"position = {number(list(position))}", f"velocity = {number(list(velocity))}", f"angle_degrees = {number(angle)}"]
    return "\n".join(lines)


def write(folder, scenes):
    folder.mkdir(parents=True)
    for id, bodies in enumerate(scenes):
        head = f"id = {id}\nframes.duration = {DURATION}"
        (folder / f"scene_{id:02}.toml").write_text("\n\n".join((head, *bodies)) + "\n")


def three_materials(generator):
    kinds, discs = generator.sample(MATERIALS, 3), []
    while len(discs) < 3:
        # 370 to 700 particles.
        radius = SPACING * math.sqrt(generator.uniform(370, 700) / math.pi)
        margin = WALL + radius + 2 * SPACING
        centre = [generator.uniform(margin, 1 - margin) for _ in range(2)]
        if all(math.dist(centre, other) > radius + reach + 3 * SPACING for other, reach in discs):
            discs.append((centre, radius))
    velocities = [[generator.uniform(-1.5, 1.5) for _ in range(2)] for _ in discs]
    bodies = zip(kinds, discs, velocities)
    return [body(kind, {"disc": {"radius": radius}}, centre, velocity) for kind, (centre, radius), velocity in bodies]


def dam_break(generator):
    """At the left or the right wall."""
    height = generator.uniform(0.6, 0.85)
    width = (1 - 2 * WALL) ** 2 / 3 / height
    left = generator.choice((WALL, 1 - WALL - width))
    return [body("liquid", {"rectangle": {"size": [width, height]}}, (left + width / 2, WALL + height / 2))]


def fast(eddy, seed, generator):
    with tempfile.TemporaryDirectory() as folder:
        command = [eddy, "--quiet", "simulate", "--preset", "kinds", "--scenes", "15", "--seed", str(seed), "--duration", "0.05"]
        subprocess.run([*command, "--output", f"{folder}/bags"], check=True)
        manifest = json.loads(Path(folder, "bags", "manifest.json").read_text())
    for scene in manifest["scenes"]:
        bodies = []
        for of_kinds in scene["scene"]["bodies"]:
            speed, direction = generator.uniform(3, 5), generator.uniform(0, 2 * math.pi)
            velocity = (speed * math.cos(direction), speed * math.sin(direction))
            place = of_kinds["position"], velocity, of_kinds.get("angle_degrees", 0.0)
            bodies.append(body(of_kinds["material"], of_kinds["shape"], *place))
        yield bodies


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--eddy", type=Path, required=True, help="the program")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn here")
    parser.add_argument("--kinds-seed", type=int, default=1001, help="of the scenes of kinds")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output}: found a file or folder, expected none")
    generator = random.Random(options.seed)
    write(options.output / "three_materials", (three_materials(generator) for _ in range(10)))
    write(options.output / "dam_break", (dam_break(generator) for _ in range(5)))
    write(options.output / "fast", fast(options.eddy, options.kinds_seed, generator))


if __name__ == "__main__":
    main()
