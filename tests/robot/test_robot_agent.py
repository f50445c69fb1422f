"""The folder's agent sees, decides and moves its gaze as the JAX agent does."""

from __future__ import annotations

import functools
import json
import re

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.envs.gymnasium import gray_frames, make_frames
from foajax.sensors import frames
from foajax.sensors.sense import sense

robot = pytest.importorskip("agent", reason="needs the extra robot")
folder = pytest.importorskip("foajax.robot.folder", reason="needs the extra robot")
Agent, AgentError = robot.Agent, robot.AgentError

RINGS = "sensor.rings=[[21,18,1],[40,44,3],[64,60,5]]"  # areas that blocks do not divide
SENSORS = {
    "canvas": [RINGS, "sensor.peripheral=[5,7]", "gaze.bounds=point"],
    "packed": [RINGS, "sensor.peripheral=[5,7]", "sensor.layout=packed"],
    "strides": [RINGS, "sensor.peripheral=[7,5]", "sensor.layout=packed", "sensor.pooling=stride"],
    "no periphery": [RINGS],
    "area": ["experiment=logpolar"],
    "bilinear": ["experiment=logpolar", "sensor.sampling=bilinear", "sensor.radius=20"],
    "whole": ["experiment=nonfoa"],
}
EPISODES = {
    "learned": ["experiment=constant70_p_packed"],
    "canvas": ["experiment=decreasing_p", "gaze.bounds=point", "gaze.actions=9", "gaze.step=11"],
    "several sizes": [
        *("experiment=constant50_sub2_packed", "gaze.step=[3,20]", "gaze.bounds=fovea"),
        *("gaze.start=random", "gaze.cost=0.3", "gaze.cost_per=saccade"),
    ],
    "absolute": [
        *("experiment=constant50_sub2_packed", "gaze.moves=absolute", "gaze.grid=[3,4]", "gaze.bounds=point"),
        "gaze.cost=0.05",
    ],
    "log-polar": ["experiment=logpolar", "gaze.step=7", "gaze.start=[70,3]"],
    "none": ["experiment=nonfoa"],
    "frozen": ["experiment=constant50_sub1_packed", "gaze=frozen", "gaze.start=[20,60]"],
    "none, cells": ["experiment=constant50_sub1_packed", "gaze=none", "gaze.start=[20,60]", "gaze.moves=absolute"],
    "frozen, cells": ["experiment=constant50_sub1_packed", "gaze=frozen", "gaze.start=[20,60]", "gaze.moves=absolute"],
    "scripted": ["experiment=constant50_sub2", "gaze=scripted", "gaze.path=[[0,0],[40,50],[79,20]]"],
    "as older agents": [
        *("experiment=constant70_packed", "network.last_actions=false", "network.last_reward=false"),
        *("network.focal_scale=frame", "network.normalization=running"),
    ],
    "in colour": ["experiment=constant70_p_packed", "env.color=true"],
    "a canvas in colour": ["experiment=constant70_p", "env.color=true", "network.normalization=frame"],
    "log-polar in colour": ["experiment=logpolar", "env.color=true", "network.normalization=running"],
    "its own frames": ["experiment=constant50_sub2_packed", "network.normalization=frame", "env.clip_rewards=false"],
}


@pytest.mark.parametrize("normalisation", ["pixel", "running", "frame", "none"])
@pytest.mark.parametrize("words", SENSORS.values(), ids=SENSORS)
def test_it_sees_what_the_sensor_gives_of_normalised_frames(words, normalisation, make_stored):
    stored = make_stored(*words, f"network.normalization={normalisation}")
    config, random = stored.agent.config, np.random.default_rng(0)
    sensor = robot.Sensor(folder.facts(stored), folder.arrays(stored.agent, stored.statistics))
    frame = random.random(config.env.frame_shape, np.float32)
    look = jax.jit(functools.partial(sense, sensor=config.sensor, bounds=config.gaze.bounds))
    whole = frames.normalise(jnp.asarray(frame), stored.statistics, mode=normalisation)
    (low, high), kind = folder.facts(stored)["gaze"]["limits"], np.int32
    for point in [low, high, [low[0], high[1]], *random.integers(low, np.array(high) + 1, (5, 2))]:
        wanted = look(whole, jnp.asarray(point, kind))
        found = sensor.look(frame, np.array(point))
        assert len(found) == len(wanted)
        for here, there in zip(found, wanted, strict=True):
            assert here.dtype == np.float32
            np.testing.assert_allclose(here, there[..., 0], atol=2e-5)


@pytest.mark.parametrize("words", EPISODES.values(), ids=EPISODES)
def test_it_decides_as_the_jax_agent_does(words, make_stored, fill, decisions):
    stored, random = make_stored(*words), np.random.default_rng(2)
    screens = random.integers(0, 256, (12, *stored.agent.screen_shape), np.uint8)
    rewards = random.normal(size=12).astype(np.float32)
    is_first = np.isin(np.arange(12), [0, 7])
    agent = Agent(fill(stored), greedy=True)
    clip = np.sign if stored.agent.config.env.clip_rewards else np.float32
    recorded = decisions(stored, screens, clip(rewards).astype(np.float32), is_first)
    for step, (output, network) in enumerate(recorded):
        if is_first[step]:
            agent.reset()
            if stored.agent.config.gaze.start == "random":
                agent.focal_point = np.array(output.focal_point[0])
        assert agent.focal_point.tolist() == output.focal_point[0].tolist()
        actions = agent.decide(screens[step], float(rewards[step]))
        assert agent.looked_at.tolist() == output.focal_point[0].tolist()
        assert actions == (output.natural_action[0], output.vision_action[0])
        np.testing.assert_allclose(agent.outputs["natural_logits"], network.natural_logits, atol=1e-5)
        np.testing.assert_allclose(agent.core["cell"], agent.outputs["next_cell"])


def test_frames_of_another_shape_and_rewards_that_are_never_clipped(make_stored, fill, decisions):
    stored = make_stored("experiment=seek", "network.last_reward=true", "game=seek", actions=2, crop_top=None)
    shape, random = stored.agent.config.env.frame_shape, np.random.default_rng(3)
    images = random.integers(0, 256, (5, *shape), np.uint8)
    rewards, is_first = np.float32([0, 0.3, -2, 0.5, 0]), np.arange(5) == 0
    agent = Agent(fill(stored), greedy=True)
    for step, (_, network) in enumerate(decisions(stored, images, rewards, is_first)):
        agent.decide(images[step], float(rewards[step]))
        np.testing.assert_allclose(agent.outputs["natural_logits"], network.natural_logits, atol=1e-5)


@pytest.mark.parametrize("crop_top", [0, 20, 50])
def test_screens_become_frames_bit_for_bit(crop_top):
    screen = np.random.default_rng(0).integers(0, 256, (210, 160), np.uint8)
    wanted = np.asarray(frames.crop_and_halve(jnp.asarray(screen), crop_top))
    assert (robot.halve(screen, crop_top) == wanted).all()


def test_an_agent_of_whole_screens_shrinks_them_as_the_engines_do(make_stored, fill):
    stored = make_stored(
        "experiment=constant50_sub2_packed", "env.crop=false", "env.frame_shape=[84,84]", crop_top=None
    )
    screen = np.random.default_rng(0).integers(0, 256, (210, 160), np.uint8)
    shrunk = cv2.resize(screen, (84, 84), interpolation=cv2.INTER_AREA)
    agent = Agent(fill(stored))
    difference = np.rint(255 * agent.frame(screen)) - shrunk  # exact halves may be rounded the other way
    assert np.abs(difference).max() <= 1 and np.mean(difference != 0) < 0.01
    np.testing.assert_array_equal(np.rint(255 * agent.frame(shrunk)), shrunk)


@pytest.mark.parametrize("opencv", [True, False], ids=["OpenCV", "NumPy alone"])
@pytest.mark.parametrize("shape", [(1080, 1920), (480, 641), (160, 160), (97, 131), (60, 50), (80, 400)])
@pytest.mark.parametrize("colours", [(), (3,)], ids=["gray", "colour"])
def test_camera_images_become_the_frames_of_training(shape, colours, opencv, monkeypatch):
    monkeypatch.setattr(robot, "cv2", robot.cv2 if opencv else None)
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (*(-(-size // 5) for size in shape), *colours), np.uint8)
    image = image.repeat(5, 0).repeat(5, 1)[: shape[0], : shape[1]]
    wanted = gray_frames(image[None], (80, 80))[0]
    found = robot.shrink(image, (80, 80), robot.LUMA)
    assert found.dtype == np.uint8
    difference = np.abs(found.astype(int) - wanted)
    assert difference.max() <= 1
    # Colours that are mixed last differ most where few pixels are added up.
    assert difference.mean() < (0.15 if min(shape) >= 160 and colours else 0.001)
    # A part of the frame is what it is in the whole frame, and takes nothing from elsewhere.
    part = slice(3, 37), slice(20, 80)
    blank = np.zeros_like(found)
    blank[part] = found[part]
    assert (robot.shrink(image, (80, 80), robot.LUMA, part) == blank).all()


@pytest.mark.parametrize("color", [False, True])
@pytest.mark.parametrize(
    "experiment", ["constant50_sub2_packed", "constant70_p_packed", "decreasing", "search_logpolar"]
)
def test_only_what_is_looked_at_is_made_of_a_cameras_image(experiment, color, make_stored, fill):
    words = [f"experiment={experiment}", "gaze.bounds=point", f"env.color={color}"]
    agent = Agent(fill(make_stored(*words)), source="camera")
    shape = agent.facts["frame_shape"]
    image = np.random.default_rng(0).integers(0, 256, (2 * shape[0] + 31, 3 * shape[1] + 7, 3), np.uint8)
    whole = agent.frame(image)
    for point in ([0, 0], [shape[0] // 2, shape[1] // 2], [shape[0] - 1, 5]):
        point = np.array(point)
        for sensor in agent._sensors:
            seen = sensor.look(agent.frame(image, sensor.reads(point)), point)
            for part, expected in zip(seen, sensor.look(whole, point), strict=True):
                np.testing.assert_array_equal(part, expected)


@pytest.mark.parametrize("shape", [(480, 641), (97, 131), (60, 400), (80, 80)])
def test_an_agent_of_colours_looks_through_a_colour_camera(shape, make_stored, fill):
    path = fill(make_stored("experiment=constant50_sub2_packed", "env.color=true"))
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    rgb, bgr = (Agent(path, source="camera", order=order) for order in ("rgb", "bgr"))
    wanted = make_frames(image[None], (80, 80), color=True)[0]
    difference = np.abs(np.rint(255 * rgb.frame(image)) - wanted)  # exact halves may be rounded the other way
    assert difference.max() <= 1 and difference.mean() < 0.001
    np.testing.assert_array_equal(bgr.frame(image[..., ::-1]), rgb.frame(image))
    for agent, accepted in ((rgb, "[h, w, 3]"), (Agent(path), "[210, 160, 3]")):
        with pytest.raises(AgentError, match=re.escape(f"frame=uint8 [210, 160]: accepted is uint8 {accepted}")):
            agent.frame(np.zeros((210, 160), np.uint8))


def test_colours_may_come_in_either_order(make_stored, fill):
    path = fill(make_stored("experiment=constant50_sub2_packed"))
    image = np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8)
    rgb, bgr = (Agent(path, source="camera", order=order) for order in ("rgb", "bgr"))
    assert (rgb.frame(image) == bgr.frame(image[..., ::-1])).all()
    assert (rgb.frame(image) != bgr.frame(image)).any()


def test_actions_are_drawn_from_the_policy_and_from_the_seed(make_stored, fill):
    path = fill(make_stored("experiment=constant50_sub2_packed"))
    agent, again, other = (Agent(path, seed=seed) for seed in (0, 0, 1))
    logits = np.log(np.array([[0.1, 0.2, 0.7]], np.float32))
    drawn = [agent._choose(logits) for _ in range(4000)]
    assert drawn == [again._choose(logits) for _ in range(4000)]
    assert drawn != [other._choose(logits) for _ in range(4000)]
    np.testing.assert_allclose(np.bincount(drawn) / 4000, [0.1, 0.2, 0.7], atol=0.03)


def test_a_gaze_at_random_starts_and_moves_within_its_limits(make_stored, fill):
    words = ["experiment=constant50_sub2_packed", "gaze=random", "gaze.start=random"]
    agent = Agent(fill(make_stored(*words)), greedy=True)
    screen, starts, visions = np.zeros((210, 160), np.uint8), set(), []
    low, high = agent.facts["gaze"]["limits"]
    for _ in range(30):
        agent.reset()
        starts.add(tuple(agent.focal_point))
        for _ in range(5):
            before = agent.focal_point
            _, vision = agent.decide(screen)
            visions.append(vision)
            moved = before + np.array(agent.facts["gaze"]["moves"])[vision]
            assert (agent.focal_point == np.clip(moved, low, high)).all()
    assert len(starts) > 15
    assert set(visions) == set(range(5))


SCREENS = "accepted is uint8 [210, 160], gray; source='camera' takes any size"
BAD_SCREENS = [
    (np.zeros((210, 160), np.float32), f"frame=float32 [210, 160]: {SCREENS}"),
    (np.zeros((210, 160, 3), np.uint8), f"frame=uint8 [210, 160, 3]: {SCREENS}"),
    (np.zeros((80, 80), np.uint8), f"frame=uint8 [80, 80]: {SCREENS}"),
    ("screen", f"frame=str []: {SCREENS}"),
    (None, f"frame=NoneType []: {SCREENS}"),
]
BAD_IMAGES = [
    (np.zeros((90, 90, 4), np.uint8), "frame=uint8 [90, 90, 4]: accepted is uint8 [h, w] or [h, w, 3]"),
    (np.zeros((0, 90), np.uint8), "frame=uint8 [0, 90]: accepted is uint8 [h, w] or [h, w, 3]"),
    (np.zeros((90, 90, 3)), "frame=float64 [90, 90, 3]: accepted is uint8 [h, w] or [h, w, 3]"),
    (np.zeros(90, np.uint8), "frame=uint8 [90]: accepted is uint8 [h, w] or [h, w, 3]"),
]


def test_what_is_no_frame_is_one_line_and_changes_nothing(make_stored, fill):
    path = fill(make_stored("experiment=constant50_sub2_packed"))
    for source, cases in (("screen", BAD_SCREENS), ("camera", BAD_IMAGES)):
        agent = Agent(path, source=source)
        agent.decide(np.zeros((210, 160), np.uint8))
        before = agent.core, agent.age, agent.focal_point, agent.last_actions
        for frame, message in cases:
            with pytest.raises(AgentError) as error:
                agent.decide(frame)
            assert str(error.value) == message
        with pytest.raises(AgentError, match="reward=nan: accepted is a finite number"):
            agent.decide(np.zeros((210, 160), np.uint8), float("nan"))
        assert before == (agent.core, agent.age, agent.focal_point, agent.last_actions)


def test_other_sources_and_orders_are_refused(make_stored, fill):
    path = fill(make_stored("experiment=seek", "game=seek", actions=2, crop_top=None))
    for source in ("screen", "file"):
        with pytest.raises(AgentError, match=f"source={source}: accepted is camera"):
            Agent(path, source=source)
    with pytest.raises(AgentError, match="order=gbr: accepted is rgb or bgr"):
        Agent(path, order="gbr").decide(np.zeros((200, 200, 3), np.uint8))


def test_a_folder_that_is_not_as_it_was_exported_is_refused(make_stored, fill, tmp_path):
    path = fill(make_stored("experiment=constant50_sub2_packed"))
    whole = (path / "policy.onnx").read_bytes()
    (path / "policy.onnx").write_bytes(whole[:-1] + b"x")
    with pytest.raises(AgentError, match="policy.onnx: is not the file that was exported; export again"):
        Agent(path)
    (path / "policy.onnx").write_bytes(whole)
    facts = json.loads((path / "agent.json").read_text())
    (path / "agent.json").write_text(json.dumps(facts | {"format": 2}))
    with pytest.raises(AgentError, match="has format 2; accepted by this agent.py is 1"):
        Agent(path)
    (path / "agent.json").write_text("{")
    with pytest.raises(AgentError, match="accepted is a folder that foajax export wrote"):
        Agent(path)
    with pytest.raises(AgentError, match="accepted is a folder that foajax export wrote .*No such file.*/agent.json"):
        Agent(tmp_path)
