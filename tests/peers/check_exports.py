"""Check exports, imports and pictures with independent programs: numpy, meshio, h5py, Pillow.

    check_exports.py EDDY BAGS

EDDY is the program, BAGS a directory of at least three bags with one stream each, all of the same shape. The frames
that rosbags reads from them are the reference. Checks:
1. Every format of `eddy bag export` contains these frames: npz, csv, gns (numpy), vtu and ply (meshio), hdf5 (h5py) and
   vtkhdf (VTK's own reader, which is ParaView's; both skipped with a note if EDDY was built without HDF5).
2. gns and hdf5 data sets work as the loaders of geoelements/gns and LagrangeBench use them, and the statistics
   in metadata.json equal those that numpy computes.
3. Conversely, `eddy bag import` reads files written by numpy (and h5py), and rejects pickles.
4. Pillow opens the pictures of `eddy bag render`.
Exports are also checked with the same streams in space, which `eddy bag import` makes of arrays by numpy.
Exits with 1 and a message if a check fails.
"""

import csv
import json
import subprocess
import sys
import tempfile
import xml.etree.ElementTree
from pathlib import Path

import meshio
import numpy
from PIL import Image
from rosbags.rosbag2 import Reader

from prediction_bag import typestore

MATERIALS = ["liquid", "snow", "jelly", "rope", "sand"]
GNS_TYPES = numpy.array([5, 4, 7, 8, 6])
LAGRANGEBENCH_TYPES = numpy.array([0, 4, 5, 6, 7])
PARTS = ["train", "valid", "test"]


def expect(holds, sentence):
    if not holds:
        sys.exit(f"check_exports.py: {sentence}")


def same(found, expected, what):
    found, expected = numpy.asarray(found), numpy.asarray(expected)
    expect(found.shape == expected.shape, f"{what}: found shape {found.shape}, expected {expected.shape}")
    expect(numpy.array_equal(found, expected), f"{what}: found {found}, expected {expected}")


def close(found, expected, what):
    expect(numpy.allclose(found, expected, rtol=1e-4, atol=1e-9), f"{what}: found {found}, expected {expected}")


class Truth:
    """One stream as rosbags reads it. Position and velocity are [frames, particles, 2 or 3]."""

    def __init__(self, bag, store):
        with Reader(bag) as reader:
            messages = [store.deserialize_cdr(data, of.msgtype) for of, _, data in reader.messages()]
        first = messages[0]
        self.stream, self.dt, self.material = int(first.stream), first.dt, first.material
        self.lower, self.upper, self.dimension = first.lower, first.upper, len(first.lower)
        self.sequence = [message.sequence for message in messages]
        stamps = [message.header.stamp for message in messages]
        self.stamp = [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps]
        self.position = numpy.stack([message.position.reshape(-1, self.dimension) for message in messages])
        self.velocity = numpy.stack([message.velocity.reshape(-1, self.dimension) for message in messages])
        self.name = f"stream_{self.stream:04}"


def eddy(program, *arguments):
    outcome = subprocess.run([program, "--quiet", *map(str, arguments)], capture_output=True, text=True)
    expect(outcome.returncode == 0, f"eddy {' '.join(map(str, arguments))}: {outcome.stderr}")


def refused(program, *arguments):
    outcome = subprocess.run([program, "--quiet", *map(str, arguments)], capture_output=True, text=True)
    expect(outcome.returncode == 1, f"eddy {' '.join(map(str, arguments))}: exit code {outcome.returncode}, expected 1")
    return outcome.stderr


def export(program, bags, work, form):
    output = work / (form if form != "csv" else "table.csv")
    eddy(program, "bag", "export", bags, "--format", form, "--output", output)
    return output


def check_npz(directory, truths):
    for truth in truths:
        arrays = numpy.load(directory / f"{truth.name}.npz", allow_pickle=False)
        for name in ["position", "velocity", "material", "stamp", "sequence", "dt", "lower", "upper", "stream"]:
            same(arrays[name], getattr(truth, name), f"npz: {truth.name}: {name}")
        if truth.dimension == 2:
            expect(arrays["stiffness"] == 1e3, f"npz: {truth.name}: stiffness: found {arrays['stiffness']}, expected 1e3")


def check_csv(path, truths):
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    frames, particles = truths[0].position.shape[:2]
    expect(len(rows) == len(truths) * frames * particles, f"csv: found {len(rows)} rows")
    for number in range(0, len(rows), 997):
        row, truth = rows[number], truths[number // (frames * particles)]
        frame, particle = number // particles % frames, number % particles
        expect(int(row["stream"]) == truth.stream and int(row["particle"]) == particle, f"csv: row {number}: {row}")
        expect(row["material"] == MATERIALS[truth.material[particle]], f"csv: row {number}: {row}")
        close(float(row["time"]), truth.stamp[frame] / 1e9, f"csv: row {number}: time")
        axes = "xyz"[: truth.dimension]
        numbers = numpy.array([row[name] for name in [*axes, *(f"v{axis}" for axis in axes)]]).astype(numpy.float32)
        same(numbers, [*truth.position[frame, particle], *truth.velocity[frame, particle]], f"csv: row {number}")


def check_meshes(directory, truths, ending):
    for truth in truths:
        files = sorted((directory / truth.name).glob(f"*.{ending}"))
        expect(len(files) == len(truth.position), f"{ending}: found {len(files)} files, expected {len(truth.position)}")
        for frame, file in enumerate(files):
            mesh = meshio.read(file)
            what = f"{ending}: {truth.name}: frame {frame}"
            same(mesh.points[:, : truth.dimension], truth.position[frame], f"{what}: points")
            data = mesh.point_data
            velocity = data["velocity"] if ending == "vtu" else numpy.stack([data[f"v{a}"] for a in "xyz"], axis=1)
            same(velocity[:, : truth.dimension], truth.velocity[frame], f"{what}: velocity")
            others = [*mesh.points[:, truth.dimension :].flat, *velocity[:, truth.dimension :].flat]
            expect(not any(others), f"{what}: the third axis is not 0")
            same(data["material"], truth.material, f"{what}: material")
            if ending == "vtu":
                same(mesh.cells_dict["vertex"].ravel(), range(len(mesh.points)), f"{what}: cells")
                close(mesh.field_data["TimeValue"], [truth.stamp[frame] / 1e9], f"{what}: time")
                expect(numpy.isfinite(data["density"]).all(), f"{what}: density")
                expect(data["strain"].shape == (len(truth.material), 3 if truth.dimension == 2 else 6), f"{what}: strain")
                if frame == 0:
                    close(numpy.median(data["density"]), 1.0, f"{what}: density")
                    expect(abs(numpy.nan_to_num(data["strain"])).max() < 1e-3, f"{what}: strain")


def check_collections(directory, truths):
    for truth in truths:
        tree = xml.etree.ElementTree.parse(directory / f"{truth.name}.pvd")
        entries = tree.findall("./Collection/DataSet")
        close([float(entry.get("timestep")) for entry in entries], numpy.array(truth.stamp) / 1e9, "pvd: times")
        expect(all((directory / entry.get("file")).exists() for entry in entries), "pvd: a file is missing")


def check_metadata(directory, truths):
    """Check metadata.json. `truths` has one stream per part; the first is the training part."""
    metadata = json.loads((directory / "metadata.json").read_text())
    truth = truths[0]
    velocity = numpy.diff(truth.position.astype(float), axis=0)
    acceleration = numpy.diff(velocity, axis=0)
    for name, values in [("vel", velocity), ("acc", acceleration)]:
        close(metadata[f"{name}_mean"], values.mean((0, 1)), f"{directory.name}: {name}_mean")
        close(metadata[f"{name}_std"], values.std((0, 1)), f"{directory.name}: {name}_std")
    close(metadata["dt"] * metadata["write_every"], truth.dt, f"{directory.name}: dt")
    same(metadata["bounds"], numpy.stack([truth.lower, truth.upper], axis=1), f"{directory.name}: bounds")
    same(metadata["sequence_length"], len(truth.position) - 1, f"{directory.name}: sequence_length")
    same(metadata["num_particles_max"], len(truth.material), f"{directory.name}: num_particles_max")
    same(metadata["dim"], truth.dimension, f"{directory.name}: dim")
    expect(0 < metadata["default_connectivity_radius"] < 0.1, f"{directory.name}: default_connectivity_radius")


def check_gns(directory, truths):
    for part, truth in zip(PARTS, truths):
        # As geoelements/gns reads it, but without allow_pickle.
        with numpy.load(directory / f"{part}.npz", allow_pickle=False) as file:
            data = file["gns_data"]
        expect(len(data) == 1 and len(data[0]) == 2, f"gns: {part}: found {len(data)} trajectories")
        for position, particle_type in data:
            same(position, truth.position, f"gns: {part}: position")
            same(numpy.full(position.shape[1], particle_type, dtype=int), GNS_TYPES[truth.material], f"gns: {part}: type")
    check_metadata(directory, truths)


def check_hdf5(directory, truths):
    import h5py

    for part, truth in zip(PARTS, truths):
        with h5py.File(directory / f"{part}.h5") as file:
            expect(list(file) == ["00000"], f"hdf5: {part}: found {list(file)}")
            position = file["00000/position"]
            expect(position.compression == "gzip", f"hdf5: {part}: found compression {position.compression}")
            same(position[:], truth.position, f"hdf5: {part}: position")
            # As LagrangeBench reads a window.
            window = position[2:9].transpose((1, 0, 2))
            same(window, truth.position[2:9].transpose((1, 0, 2)), f"hdf5: {part}: window")
            same(file["00000/particle_type"][:], LAGRANGEBENCH_TYPES[truth.material], f"hdf5: {part}: type")
    check_metadata(directory, truths)


def check_imported(program, bags, truth, store, what, velocity=True):
    found = Truth(sorted(bags.iterdir())[0], store)
    same(found.position, truth.position, f"{what}: position")
    same(found.material, truth.material, f"{what}: material")
    close(found.dt, truth.dt, f"{what}: dt")
    if velocity:
        same(found.velocity, truth.velocity, f"{what}: velocity")
    else:
        steps = numpy.diff(truth.position, axis=0) / numpy.float32(truth.dt)
        close(found.velocity, numpy.concatenate([steps[:1], steps]), f"{what}: velocity")
    for bag in bags.iterdir():
        eddy(program, "bag", "check", bag)


def check_import_npz(program, work, truth, store):
    arrays = {"position": truth.position, "velocity": truth.velocity, "material": truth.material, "dt": truth.dt}
    kinds = {
        "plain": (numpy.savez, arrays),
        "compressed": (numpy.savez_compressed, arrays),
        "doubles": (numpy.savez, {name: numpy.asarray(array, float) for name, array in arrays.items()}),
        "swapped": (numpy.savez, {name: numpy.asarray(array).astype(">f4") for name, array in arrays.items()}),
    }
    for name, (save, content) in kinds.items():
        file, bags = work / f"{name}.npz", work / f"{name}_bags"
        save(file, **content, stamp=truth.stamp) if name != "swapped" else save(file, **content)
        eddy(program, "bag", "import", file, "--format", "npz", "--output", bags)
        check_imported(program, bags, truth, store, f"import npz, {name}")


def check_import_gns(program, work, truth, store):
    position, types = truth.position, GNS_TYPES[truth.material]
    fields = [("position", position.dtype, position.shape), ("particle_type", types.dtype, types.shape)]
    trusted, bags = work / "structured.npz", work / "structured_bags"
    numpy.savez_compressed(trusted, gns_data=numpy.array([(position, types)], dtype=fields))
    eddy(program, "bag", "import", trusted, "--format", "gns", "--dt", truth.dt, "--output", bags)
    check_imported(program, bags, truth, store, "import gns", velocity=False)

    pickled = numpy.empty(2, dtype=object)
    pickled[:] = [position, types]
    for name, content in [("simulation_trajectory_0", pickled), ("gns_data", numpy.array([pickled], dtype=object))]:
        file, output = work / "pickled.npz", work / "pickled_bags"
        numpy.savez_compressed(file, **{name: content})
        message = refused(program, "bag", "import", file, "--format", "gns", "--dt", truth.dt, "--output", output)
        expect(name in message and "object arrays are pickles" in message, f"import gns: {message}")
        expect(not output.exists(), f"import gns: {output} was written")


def check_vtkhdf(directory, truths, meshes):
    """Check against the frames, and the other properties against the VTU files in `meshes`."""
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    for truth in truths:
        reader = vtk.vtkHDFReader()
        reader.SetFileName(str(directory / f"{truth.name}.vtkhdf"))
        reader.UpdateInformation()
        times = reader.GetOutputInformation(0).Get(vtk.vtkStreamingDemandDrivenPipeline.TIME_STEPS())
        close(times, numpy.array(truth.stamp) / 1e9, f"vtkhdf: {truth.name}: times")
        for frame, time in enumerate(times):
            reader.UpdateTimeStep(time)
            grid, what = reader.GetOutput(), f"vtkhdf: {truth.name}: frame {frame}"
            same(vtk_to_numpy(grid.GetPoints().GetData())[:, : truth.dimension], truth.position[frame], f"{what}: points")
            expect(grid.GetNumberOfCells() == len(truth.material), f"{what}: found {grid.GetNumberOfCells()} cells")
            mesh = meshio.read(meshes / truth.name / f"{frame:06}.vtu")
            for name, values in mesh.point_data.items():
                found = vtk_to_numpy(grid.GetPointData().GetArray(name))
                expect(numpy.array_equal(found, values, equal_nan=True), f"{what}: {name} differs from the VTU file")


def check_import_hdf5(program, work, truth, store):
    import h5py

    directory, bags = work / "by_h5py", work / "by_h5py_bags"
    directory.mkdir()
    with h5py.File(directory / "test.h5", "w") as file:
        file.create_dataset("00000/particle_type", data=LAGRANGEBENCH_TYPES[truth.material])
        file.create_dataset("00000/position", data=truth.position, dtype=numpy.float32, compression="gzip")
    eddy(program, "bag", "import", directory, "--format", "hdf5", "--dt", truth.dt, "--output", bags)
    check_imported(program, bags, truth, store, "import hdf5", velocity=False)


def lift(program, truths, work, store):
    """The same streams in space: numpy adds an axis, `eddy bag import` makes bags of the arrays."""
    arrays, bags = work / "arrays", work / "bags"
    arrays.mkdir()
    for truth in truths:
        depth = numpy.linspace(0.2, 0.4, len(truth.material), dtype=numpy.float32)[None, :, None]
        position = numpy.concatenate([truth.position, depth + 0.1 * truth.position[:, :, :1]], axis=2)
        velocity = numpy.concatenate([truth.velocity, 0.1 * truth.velocity[:, :, :1]], axis=2)
        corners = {"lower": [*truth.lower, 0], "upper": [*truth.upper, 0.75], "stream": truth.stream}
        others = {name: getattr(truth, name) for name in ["material", "stamp", "sequence", "dt"]}
        numpy.savez(arrays / f"{truth.name}.npz", position=position, velocity=velocity, **others, **corners)
    eddy(program, "bag", "import", arrays, "--format", "npz", "--output", bags)
    lifted = [Truth(bag, store) for bag in sorted(bags.iterdir())]
    for truth in lifted:
        stored = numpy.load(arrays / f"{truth.name}.npz")
        same(truth.position, stored["position"].astype(numpy.float32), f"import npz: {truth.name}: position in space")
        same(truth.velocity, stored["velocity"].astype(numpy.float32), f"import npz: {truth.name}: velocity in space")
    return bags, lifted


def check_tables_and_meshes(program, bags, truths, work):
    check_npz(export(program, bags, work, "npz"), truths)
    check_csv(export(program, bags, work, "csv"), truths)
    check_meshes(export(program, bags, work, "ply"), truths, "ply")
    check_meshes(export(program, bags, work, "vtu"), truths, "vtu")
    check_collections(work / "vtu", truths)
    check_gns(export(program, bags, work, "gns"), truths)


def check_with_hdf5(program, bags, truths, work):
    check_hdf5(export(program, bags, work, "hdf5"), truths)
    check_vtkhdf(export(program, bags, work, "vtkhdf"), truths, work / "vtu")


def check_pictures(program, bag, work):
    for color in ["material", "speed"]:
        output = work / f"pictures_{color}"
        eddy(program, "bag", "render", bag, "--color", color, "--output", output)
        moving = work / f"{color}.apng"
        eddy(program, "bag", "render", bag, "--color", color, "--output", moving)
        for path in [output / "strip.png", output / "animation.gif", moving]:
            with Image.open(path) as image:
                frames = getattr(image, "n_frames", 1)
                expect((frames > 1) == (path.suffix != ".png"), f"{path.name}: found {frames} pictures")
                for frame in range(frames):
                    image.seek(frame)
                    image.load()
                expect(len(image.convert("RGB").getcolors(1 << 24)) > 5, f"{path.name}: nothing is drawn")


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    program, bags = sys.argv[1], Path(sys.argv[2])
    store = typestore()
    truths = [Truth(bag, store) for bag in sorted(bags.glob("scene_*"))]
    expect(len(truths) == len(PARTS), f"{bags}: found {len(truths)} bags, expected {len(PARTS)}")
    with tempfile.TemporaryDirectory() as directory:
        work = Path(directory)
        check_tables_and_meshes(program, bags, truths, work)
        space = work / "space"
        space.mkdir()
        bags_in_space, truths_in_space = lift(program, truths, space, store)
        check_tables_and_meshes(program, bags_in_space, truths_in_space, space)
        print("npz, csv, ply, vtu, pvd, gns: numpy and meshio read the same as rosbags from the bags")
        check_import_npz(program, work, truths[0], store)
        check_import_gns(program, work, truths[0], store)
        print("npz, gns: files written by numpy are imported, pickles are rejected")
        without = "--features hdf5" in subprocess.run(
            [program, "bag", "export", bags, "--format", "hdf5", "--output", work / "none"], capture_output=True, text=True
        ).stderr
        if without:
            print("hdf5: skipped, the program was built without it")
        else:
            check_with_hdf5(program, bags, truths, work)
            check_with_hdf5(program, bags_in_space, truths_in_space, space)
            check_import_hdf5(program, work, truths[0], store)
            print("hdf5: h5py reads the same as rosbags from the bags, and its files are imported; so does VTK vtkhdf")
        check_pictures(program, sorted(bags.glob("scene_*"))[0], work)
        print("pictures: Pillow opens strips and animations")


if __name__ == "__main__":
    main()
