"""A ROS 2 node that holds the surrogate: predictions in the process of your own node.

    python rclpy_node.py [--ros-args -p checkpoint:=FOLDER -r particles:=/truth ...]

Subscribes to `particles` and publishes the next frame of each on `prediction` (eddy_msgs/msg/ParticleFrame). `eddy node` and
`eddy.Node` do the same without rclpy; this is for nodes that do more than that. Needs rclpy and the messages in
`msgs/eddy_msgs`, built with colcon; `tests/packages/check_ament` builds and runs it.
"""

from array import array

import eddy
import numpy as np
import rclpy
from eddy_msgs.msg import ParticleFrame
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node


def to_frame(message: ParticleFrame) -> eddy.Frame:
    """A frame from a message, whose arrays are read in place."""
    return eddy.Frame(
        np.asarray(message.position).reshape(-1, 2),
        np.asarray(message.velocity).reshape(-1, 2),
        np.asarray(message.material),
        stream=message.stream,
        sequence=message.sequence,
        time=message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec,
        dt=message.dt,
        lower=message.lower,
        upper=message.upper,
    )


def to_message(frame: eddy.Frame, frame_id: str) -> ParticleFrame:
    """A message from a frame. Arrays of the standard library are assigned without a look at every number."""
    message = ParticleFrame(
        stream=frame.stream,
        sequence=frame.sequence,
        dt=frame.dt,
        lower=frame.lower,
        upper=frame.upper,
        position=array("f", frame.position.tobytes()),
        velocity=array("f", frame.velocity.tobytes()),
        material=array("B", frame.material.tobytes()),
    )
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(frame.stamp, 10**9)
    return message


class Predictor(Node):
    """Predicts the next frame of every stream."""

    def __init__(self) -> None:
        super().__init__("predictor")
        checkpoint = self.declare_parameter("checkpoint", "").value
        self.surrogate = eddy.Surrogate(checkpoint or None, threads=1)
        #: What the network remembers of each stream, and the number of the frame that it expects next.
        self.streams: dict[int, tuple[eddy.Stream, int]] = {}
        self.publisher = self.create_publisher(ParticleFrame, "prediction", 10)
        self.create_subscription(ParticleFrame, "particles", self.on_frame, 10)

    def on_frame(self, message: ParticleFrame) -> None:
        """Observes a frame and publishes the predicted next one."""
        try:
            frame = to_frame(message)
            stream, expected = self.streams.get(frame.stream, (None, 0))
            if stream is None or frame.sequence != expected:
                # A new stream, or one with a gap: it warms up again.
                stream = self.surrogate.stream(frame)
            predicted = stream.step(frame)
        except ValueError as error:
            self.get_logger().warning(f"frame {message.sequence} of stream {message.stream}: {error}")
            return
        self.streams[frame.stream] = stream, frame.sequence + 1
        self.publisher.publish(to_message(predicted, message.header.frame_id))


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(Predictor())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
