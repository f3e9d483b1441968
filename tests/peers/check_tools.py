"""Check the tools of a VTU export with VTK's own reader, which is ParaView's.

    check_tools.py EDDY BAG

EDDY is the program, BAG a bag of one stream with one tool, a rectangle. Checks that the polygon beside every frame is where the
ToolFrame of that frame says, with its velocity, and the force and torque on it, as rosbags reads them.
Exits with 1 and a message if a check fails.
"""

import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy
import vtk
from rosbags.rosbag2 import Reader
from vtk.util.numpy_support import vtk_to_numpy

from prediction_bag import typestore


def expect(holds, sentence):
    if not holds:
        sys.exit(f"check_tools.py: {sentence}")


def tool_frames(bag):
    """The messages of /tools, by sequence number."""
    store = typestore()
    with Reader(bag) as reader:
        of_tools = [one for one in reader.connections if one.topic == "/tools"]
        messages = (store.deserialize_cdr(raw, one.msgtype) for one, _, raw in reader.messages(connections=of_tools))
        return {message.sequence: message for message in messages}


def polygon(path):
    """The corners of the only polygon of a file, and its data."""
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    found = reader.GetOutput()
    expect(found.GetNumberOfCells() == 1, f"{path.name}: found {found.GetNumberOfCells()} polygons, expected 1")
    data = found.GetCellData()
    arrays = {data.GetArrayName(k): vtk_to_numpy(data.GetArray(k))[0] for k in range(data.GetNumberOfArrays())}
    return vtk_to_numpy(found.GetPoints().GetData()), arrays


def check(path, frame):
    corners, data = polygon(path)
    pose, twist = frame.poses[0], frame.twists[0]
    close = lambda found, expected: numpy.allclose(found, expected, atol=1e-6, equal_nan=True)
    centre = corners.mean(axis=0)
    expect(close(centre, [pose.position.x, pose.position.y, 0]), f"{path.name}: found a tool at {centre}")
    along = corners[1] - corners[0]
    turn = math.atan2(along[1], along[0]) - 2 * math.atan2(pose.orientation.z, pose.orientation.w)
    expect(abs(math.remainder(turn, math.pi / 2)) < 1e-4, f"{path.name}: its sides are turned by {turn} from its pose")
    expect(close(data["velocity"], [twist.linear.x, twist.linear.y, 0]), f"{path.name}: velocity {data['velocity']}")
    expect(close(data["spin"], twist.angular.z), f"{path.name}: spin {data['spin']}")
    known = frame.wrenches[0] if frame.wrenches else None
    force = [known.force.x, known.force.y, 0] if known else [math.nan, math.nan, 0]
    expect(close(data["force"], force), f"{path.name}: found the force {data['force']}, expected {force}")
    expect(close(data["torque"], known.torque.z if known else math.nan), f"{path.name}: torque {data['torque']}")


def main(eddy, bag):
    frames = tool_frames(bag)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder, "vtu")
        subprocess.run([eddy, "--quiet", "bag", "export", bag, "--format", "vtu", "--output", work], check=True)
        files = sorted(work.glob("stream_*/*.vtp"))
        expect(len(files) == len(frames) > 0, f"found {len(files)} polygons, expected {len(frames)}")
        for path in files:
            check(path, frames[int(path.stem)])
    pushed = sum(1 for frame in frames.values() if frame.wrenches and frame.wrenches[0].force.x != 0)
    expect(pushed > 0, "nothing pushes the tool: choose another bag")
    print(f"vtp: VTK reads the tool at {len(files)} frames as rosbags does from the bag, under force at {pushed} of them")


if __name__ == "__main__":
    main(*sys.argv[1:])
