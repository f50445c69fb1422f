"""Runs the agent as a ROS 2 node: `python node.py --ros-args -p image:=/camera/image_raw`.

It listens to sensor_msgs/Image, or to CompressedImage with `-p compressed:=true`, and publishes each decision: the
natural action's number (std_msgs/Int32) and where it looked, as (x, y) in [0, 1] of the image (geometry_msgs/Point).
A message on the topic `reset` (std_msgs/Empty) begins an episode; one on `reward` (std_msgs/Float32) tells what the
last action earned. Images that come faster than `rate` are skipped.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: threads for small sums only wait for each other

import cv2
import numpy as np
import rclpy
from agent import Agent, AgentError
from geometry_msgs.msg import Point
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Empty, Float32, Int32

# Name, default, and what it is. A rate of 0 is that of the agent's training.
PARAMETERS: dict[str, Any] = {
    "folder": str(Path(__file__).parent),
    "image": "image_raw",  # topic of the images
    "compressed": False,  # whether they are CompressedImage
    "action": "natural_action",  # topic of the decisions
    "gaze": "gaze",  # topic of where it looked
    "rate": 0.0,  # decisions per second at most; 0: as in training
    "greedy": False,
    "seed": 0,
}
ENCODINGS = {"mono8": (1, "rgb"), "8UC1": (1, "rgb"), "rgb8": (3, "rgb"), "bgr8": (3, "bgr"), "8UC3": (3, "bgr")}
EARLY = 0.9  # of a period: images of a camera at about the rate come a little sooner or later


class AgentNode(Node):
    """Decides upon images as they come."""

    def __init__(self) -> None:
        super().__init__("foveated_agent")
        for name, value in PARAMETERS.items():
            self.declare_parameter(name, value)
        get = lambda name: self.get_parameter(name).value  # noqa: E731
        self.agent = Agent(get("folder"), greedy=get("greedy"), seed=get("seed"), source="camera")
        self.period = 1.0 / (get("rate") or self.agent.facts["steps_per_second"])
        self._last, self._reward = -np.inf, 0.0
        self._action = self.create_publisher(Int32, get("action"), 1)
        self._gaze = self.create_publisher(Point, get("gaze"), 1)
        kind, self._unpack = (CompressedImage, decode) if get("compressed") else (Image, unpack)
        self.create_subscription(kind, get("image"), self.on_image, qos_profile_sensor_data)
        self.create_subscription(Empty, "reset", self.on_reset, 1)
        self.create_subscription(Float32, "reward", self.on_reward, 1)

    def on_image(self, message: Image | CompressedImage) -> None:
        """Decides upon an image and publishes the decision, unless the image comes too soon."""
        if time.monotonic() - self._last < EARLY * self.period:
            return
        try:
            image, self.agent.order = self._unpack(message)
            self._last = time.monotonic()
            natural, _ = self.agent.decide(image, self._reward)
        except AgentError as error:
            self.get_logger().error(str(error))
            return
        self._reward = 0.0
        self._action.publish(Int32(data=natural))
        y, x = self.agent.looked_at / self.agent.facts["frame_shape"]
        self._gaze.publish(Point(x=float(x), y=float(y), z=0.0))
        took = time.monotonic() - self._last
        if took > self.period:
            period = f"longer than its period of {1e3 * self.period:.1f} ms"
            self.get_logger().warning(f"a decision took {1e3 * took:.1f} ms, {period}")

    def on_reset(self, _: Empty) -> None:
        """Begins an episode: memory and gaze start anew."""
        self.agent.reset()
        self._reward = 0.0

    def on_reward(self, message: Float32) -> None:
        """Takes what the last action has earned; rewards between two decisions add up."""
        self._reward += message.data


def unpack(message: Image) -> tuple[np.ndarray, str]:
    """Returns the image, uint8 [h, w] or [h, w, 3], and its order of colours; copies it only if its rows are padded.

    Raises:
      AgentError: another encoding, or fewer bytes than its size says.
    """
    if message.encoding not in ENCODINGS:
        raise AgentError(f"encoding={message.encoding}: accepted is one of {', '.join(ENCODINGS)}")
    channels, order = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if step < width * channels or len(message.data) < height * step or 0 in (height, width):
        raise AgentError(f"image={height}x{width}, step {step}, {len(message.data)} bytes: accepted is a whole image")
    rows = np.frombuffer(message.data, np.uint8, height * step).reshape(height, step)[:, : width * channels]
    return (rows if channels == 1 else rows.reshape(height, width, channels)), order


def decode(message: CompressedImage) -> tuple[np.ndarray, str]:
    """Decodes a JPEG or PNG image to uint8 [h, w, 3] and its order of colours; `AgentError` where OpenCV cannot."""
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR) if len(message.data) else None
    if image is None:
        raise AgentError(f"format={message.format}: cannot be decoded; accepted is a whole JPEG or PNG image")
    return image, "bgr"


def main() -> int:
    """Runs the node until ROS or Ctrl-C ends it; returns 1 after an error, else 0."""
    rclpy.init()
    node = None
    try:
        node = AgentNode()
        rclpy.spin(node)
    except AgentError as error:
        print(f"node: error: {error}")
        return 1
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
