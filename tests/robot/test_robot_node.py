"""The ROS 2 node, against a stand-in for rclpy and its messages."""

from __future__ import annotations

import importlib
import sys
import types

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="needs the extra robot")
robot = pytest.importorskip("agent", reason="needs the extra robot")
pytest.importorskip("onnx", reason="needs the extra robot")
Agent, AgentError = robot.Agent, robot.AgentError


class Message:
    """Any message: what it is made with."""

    def __init__(self, **fields):
        self.__dict__ |= fields


class Logger:
    def __init__(self):
        self.errors, self.warnings = [], []

    def error(self, text):
        self.errors.append(text)

    def warning(self, text):
        self.warnings.append(text)


class Node:
    """What the node uses of `rclpy.node.Node`."""

    chosen: dict = {}  # parameters given from outside

    def __init__(self, name):
        self.parameters, self.published, self.heard, self.logger = {}, {}, {}, Logger()
        self.destroyed = False

    def declare_parameter(self, name, value):
        self.parameters[name] = self.chosen.get(name, value)

    def get_parameter(self, name):
        return Message(value=self.parameters[name])

    def create_publisher(self, kind, topic, depth):
        messages = self.published.setdefault(topic, [])
        return types.SimpleNamespace(publish=messages.append)

    def create_subscription(self, kind, topic, listen, profile):
        self.heard[topic] = (kind, listen)

    def get_logger(self):
        return self.logger

    def destroy_node(self):
        self.destroyed = True


@pytest.fixture
def ros(monkeypatch):
    """The module `node`, imported where `rclpy` stands in."""
    shut = []

    class ExternalShutdownException(Exception):
        pass

    def spin(node):
        shut.append(node)
        raise ExternalShutdownException

    executors = types.SimpleNamespace(ExternalShutdownException=ExternalShutdownException)
    modules = {
        "rclpy": {"init": lambda: None, "spin": spin, "try_shutdown": lambda: shut.append("shut")},
        "rclpy.node": {"Node": Node},
        "rclpy.executors": {"ExternalShutdownException": ExternalShutdownException},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
    }
    modules["rclpy"]["executors"] = executors
    for package, names in {
        "sensor_msgs": ("Image", "CompressedImage"),
        "std_msgs": ("Empty", "Float32", "Int32"),
        "geometry_msgs": ("Point",),
    }.items():
        modules[package] = {}
        modules[f"{package}.msg"] = {name: type(name, (Message,), {}) for name in names}
    for name, contents in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "node", raising=False)
    module = importlib.import_module("node")
    module.shut = shut
    yield module
    sys.modules.pop("node", None)


@pytest.fixture
def make(ros, make_stored, fill, monkeypatch):
    """Makes a node with parameters, and a clock that `tick` moves."""
    path = fill(make_stored("experiment=constant70_p_packed"))

    def make(**parameters):
        monkeypatch.setattr(Node, "chosen", {"folder": str(path), "seed": 3} | parameters)
        node = ros.AgentNode()
        now = [100.0]
        monkeypatch.setattr(ros.time, "monotonic", lambda: now[0])
        node.tick = lambda seconds: now.__setitem__(0, now[0] + seconds)
        node.path = path
        return node

    return make


def raw(image, encoding, padding=0):
    """An image as sensor_msgs/Image has it."""
    height, width = image.shape[:2]
    rows = image.reshape(height, -1)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    return Message(height=height, width=width, step=padded.shape[1], encoding=encoding, data=padded.tobytes())


IMAGE = np.random.default_rng(0).integers(0, 256, (170, 200, 3), np.uint8)


@pytest.mark.parametrize("padding", [0, 8])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
def test_images_are_decided_upon_as_they_come(encoding, padding, make):
    node = make()
    kind, listen = node.heard["image_raw"]
    assert kind.__name__ == "Image"
    image = IMAGE[..., 0] if encoding == "mono8" else IMAGE[..., ::-1] if encoding == "bgr8" else IMAGE
    same = Agent(node.path, seed=3, source="camera")
    for _ in range(3):
        listen(raw(np.ascontiguousarray(image), encoding, padding))
        node.tick(1.0)
    wanted = [same.decide(IMAGE[..., 0] if encoding == "mono8" else IMAGE)[0] for _ in range(3)]
    assert [message.data for message in node.published["natural_action"]] == wanted
    assert not node.logger.errors
    gaze = node.published["gaze"][-1]
    assert (gaze.y, gaze.x) == tuple(same.looked_at / 80)


def test_compressed_images(make):
    node = make(compressed=True, image="/camera/compressed", action="do", gaze="look")
    kind, listen = node.heard["/camera/compressed"]
    assert kind.__name__ == "CompressedImage"
    listen(Message(format="png", data=cv2.imencode(".png", IMAGE[..., ::-1])[1].tobytes()))
    assert [message.data for message in node.published["do"]] == [
        Agent(node.path, seed=3, source="camera").decide(IMAGE)[0]
    ]
    assert len(node.published["look"]) == 1
    for data in (b"", b"no image"):
        node.tick(1.0)
        listen(Message(format="jpeg", data=data))
    assert node.logger.errors == ["format=jpeg: cannot be decoded; accepted is a whole JPEG or PNG image"] * 2
    assert node.agent.age == 1


def test_images_that_come_too_soon_are_left_out(make):
    node = make(rate=10.0)
    listen = node.heard["image_raw"][1]
    for _ in range(12):
        listen(raw(IMAGE, "rgb8"))
        node.tick(1 / 30)
    assert node.agent.age == 4
    assert make().period == pytest.approx(1 / 15)  # as in training


def test_resets_and_rewards_have_topics(make, monkeypatch):
    node = make()
    told = []
    monkeypatch.setattr(node.agent, "decide", lambda frame, reward: told.append(reward) or (0, 0))
    listen = node.heard["image_raw"][1]
    for rewards in ([], [0.25, 0.5], []):
        for reward in rewards:
            node.heard["reward"][1](Message(data=reward))
        listen(raw(IMAGE, "rgb8"))
        node.tick(1.0)
    assert told == [0.0, 0.75, 0.0]
    node.agent.age = 3
    node.heard["reward"][1](Message(data=9.0))
    node.heard["reset"][1](Message())
    assert node.agent.age == 0
    listen(raw(IMAGE, "rgb8"))
    assert told[-1] == 0.0


def test_a_decision_that_takes_too_long_is_told(make, monkeypatch):
    node = make()
    monkeypatch.setattr(node.agent, "decide", lambda frame, reward: node.tick(0.1) or (0, 0))
    node.heard["image_raw"][1](raw(IMAGE, "rgb8"))
    assert node.logger.warnings == ["a decision took 100.0 ms, longer than its period of 66.7 ms"]


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"encoding": "bayer_rggb8"}, "encoding=bayer_rggb8: accepted is one of mono8, 8UC1, rgb8, bgr8, 8UC3"),
        ({"step": 10}, "image=170x200, step 10, 102000 bytes: accepted is a whole image"),
        ({"data": b"123"}, "image=170x200, step 600, 3 bytes: accepted is a whole image"),
        ({"height": 0}, "image=0x200, step 600, 102000 bytes: accepted is a whole image"),
    ],
)
def test_images_that_are_none_are_one_line(changed, message, make):
    node = make()
    image = raw(IMAGE, "rgb8")
    image.__dict__ |= changed
    node.heard["image_raw"][1](image)
    assert node.logger.errors == [message]
    assert (node.agent.age, node.published["natural_action"]) == (0, [])


def test_the_command_ends_cleanly(ros, make):
    make()
    assert ros.main() == 0
    node, last = ros.shut
    assert (node.destroyed, last) == (True, "shut")


def test_a_folder_that_is_none_is_one_line(ros, make, capsys):
    with pytest.raises(AgentError):
        make(folder="/nowhere")
    assert ros.main() == 1
    assert ros.shut == ["shut"]
    assert "node: error: /nowhere: accepted is a folder" in capsys.readouterr().out
