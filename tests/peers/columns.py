"""Scenes that are at rest first, as scene files of `eddy simulate --scene`: heaps and columns that collapse, or stand.

    columns.py OUTPUT SCENES [--seed 1] [--materials sand]

Each has one or two rectangles of liquid, snow or jelly (or --materials), standing on the floor, that fill .1 to .4 of the unit square between the walls; every
other scene has E = 1e3, the rest 3e2 to 3e5. `kinds`, whose bodies are thrown, has no such beginning.
"""

import argparse
import random
from pathlib import Path

from unlike_scenes import SPACING, WALL, body

MATERIALS = ("liquid", "snow", "jelly")
INSIDE = 1 - 2 * WALL


def columns(generator: random.Random, materials: list[str]) -> list[str]:
    """One or two columns, side by side."""
    count = generator.choice((1, 1, 2))
    area = generator.uniform(0.1, 0.4) * INSIDE**2 / count
    bodies, left = [], WALL
    for number in range(count):
        height = generator.uniform(0.25, 0.9) * INSIDE
        most = INSIDE / count - 2 * SPACING
        width = min(max(area / height, 8 * SPACING), most)
        free = WALL + (number + 1) * INSIDE / count - left - width
        # At the wall, as in a dam break, or anywhere.
        gap = generator.choice((0.0, free, generator.uniform(0, free)))
        centre = (left + gap + width / 2, WALL + height / 2)
        bodies.append(body(generator.choice(materials), {"rectangle": {"size": [width, height]}}, centre))
        left = WALL + (number + 1) * INSIDE / count
    return bodies


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="folder for the scene files, which must not exist")
    parser.add_argument("scenes", type=int, help="number of scenes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--materials", nargs="+", default=MATERIALS, help="what the rectangles are of")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output}: found a file or folder, expected none")
    generator = random.Random(options.seed)
    options.output.mkdir(parents=True)
    for number in range(options.scenes):
        stiffness = 1e3 if number % 2 == 0 else 10 ** generator.uniform(2.5, 5.5)
        head = f"id = {100_000 * options.seed + number}\nframes.duration = 4.8\nmaterials.stiffness = {stiffness:.6g}\nmaterials.law = \"settling\""
        text = "\n\n".join((head, *columns(generator, options.materials))) + "\n"
        (options.output / f"column_{number:03}.toml").write_text(text)


if __name__ == "__main__":
    main()
