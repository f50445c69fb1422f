"""Every key of a configuration, right and wrong: a `Config`, or a `ConfigError` of one line with the name."""

from __future__ import annotations

import copy
import json
import pickle
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foajax.config.parse import ConfigError, replace, to_mapping
from foajax.config.schema import Config, GazeConfig, LogPolarSensor, RingSensor, from_mapping
from foajax.config.table import groups

RINGS = Config(name="constant70", sensor=RingSensor(rings=((70, 70, 2),)))
LOG_POLAR = Config(name="logpolar", sensor=LogPolarSensor(), gaze=GazeConfig(bounds="point"))


def paths(mapping, prefix=()):
    """Every key of nested mappings as a tuple of names, sections included."""
    for name, value in mapping.items():
        yield (*prefix, name)
        if isinstance(value, dict):
            yield from paths(value, (*prefix, name))


def changed(config, path, value):
    """`config` as a mapping with the value at `path` replaced."""
    mapping = to_mapping(config)
    section = mapping
    for name in path[:-1]:
        section = section[name]
    section[path[-1]] = value
    return mapping


def error(mapping):
    """The message with which `mapping` is refused."""
    with pytest.raises(ConfigError) as caught:
        from_mapping(mapping)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message


EVERY_KEY = [
    *((RINGS, path) for path in paths(to_mapping(RINGS))),
    *((LOG_POLAR, ("sensor", name)) for name in to_mapping(LOG_POLAR)["sensor"]),
]
SECTIONS = [
    (),
    ("sensor",),
    ("gaze",),
    ("env",),
    ("network",),
    ("learner",),
    ("learner", "natural"),
    ("train",),
]
EVERY_PATH = pytest.mark.parametrize(
    ("config", "path"), EVERY_KEY, ids=[f"{config.name}:{'.'.join(path)}" for config, path in EVERY_KEY]
)

plain_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.just(10**400) | st.floats() | st.text(max_size=100),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("abc.", max_size=5), inner, max_size=3),
    max_leaves=8,
)
small_values = st.integers(-3, 100) | st.lists(st.integers(-3, 100), max_size=3)


@EVERY_PATH
def test_a_value_of_no_accepted_type_is_refused_by_name(config, path):
    message = error(changed(config, path, {"a set"}))  # no key accepts a Python set
    assert message.startswith(".".join(path) + "=")
    assert "accepted is" in message


@settings(deadline=None, max_examples=300)
@given(key=st.sampled_from(EVERY_KEY), value=plain_values | small_values)
def test_any_plain_value_is_taken_as_it_is_or_refused_by_name(key, value):
    config, path = key
    mapping = changed(config, path, copy.deepcopy(value))
    try:
        built = from_mapping(mapping)
    except ConfigError as refused:
        assert len(str(refused).splitlines()) == 1
        assert ".".join(path) in str(refused)
        assert "accepted" in str(refused)
    else:
        section = to_mapping(built)
        for name in path:
            section = section[name]
        if isinstance(value, dict):
            assert value.items() <= section.items()
        else:
            assert section == value and isinstance(section, type(value) | float)


@settings(deadline=None)
@given(
    config=st.sampled_from([RINGS, LOG_POLAR]),
    section=st.sampled_from(SECTIONS),
    name=st.from_regex(r"[A-Za-z_][A-Za-z_.0-9]{0,15}", fullmatch=True),
)
def test_an_unknown_name_is_refused_with_the_known_ones(config, section, name):
    path = (*section, name)
    if path in set(paths(to_mapping(config))):
        return
    message = error(changed(config, path, 1))
    known = rf"{re.escape('.'.join(path))}=1: unknown key( \(did you mean [\w.]+\?\))?; accepted is one of "
    assert re.match(known, message)


@pytest.mark.parametrize("name", ["name", "sensor"])
def test_what_has_no_default_is_missed_by_name(name):
    mapping = to_mapping(RINGS)
    del mapping[name]
    assert error(mapping).startswith(f"{name}: missing")


def test_rings_without_rings_are_missed_by_name():
    assert error(changed(RINGS, ("sensor",), {"kind": "rings"})).startswith("sensor.rings: missing")


OUT_OF_RANGE = [
    ("name", " "),
    ("game", ""),
    ("seed", -1),
    ("seed", 2**31),
    ("sensor.kind", "square"),
    ("sensor.rings", []),
    ("sensor.rings", [[70, 70]]),
    ("sensor.rings", [[70, 70, 0]]),
    ("sensor.rings", [[0, 70, 1]]),
    ("sensor.rings", [[70, 70, 71]]),
    ("sensor.rings", [[50, 50, 2], [30, 30, 1]]),
    ("sensor.rings", [[50, 50, 1], [50, 50, 2]]),
    ("sensor.rings", [[82, 80, 2]]),
    ("sensor.peripheral", [0, 5]),
    ("sensor.peripheral", [5, 81]),
    ("sensor.layout", "canvass"),
    ("sensor.pooling", "max"),
    ("gaze.mode", "scripted"),  # without a path
    ("gaze.actions", 4),
    ("gaze.actions", True),
    ("gaze.step", 0),
    ("gaze.step", 2**31),
    ("gaze.bounds", "frame"),
    ("sensor.rings", [[80, 80, 2]]),  # the gaze could not move
    ("gaze.start", [80, 0]),
    ("gaze.start", "center"),
    ("gaze.path", [[0, -1]]),
    ("env.engine", "gym"),
    ("env.num_envs", 0),
    ("env.num_groups", 0),
    ("env.num_groups", 3),
    ("env.frame_shape", [7, 80]),
    ("env.crop_top", {}),
    ("env.crop_top", {"default": 51}),
    ("env.frame_skip", 0),
    ("env.frame_skip", 2**31),
    ("env.noop_max", -1),
    ("env.sticky_actions", 1.0),
    ("env.max_episode_steps", 0),
    ("env.max_episode_steps", 2**31),
    ("env.threads", -1),
    ("env.threads", 100_000),
    ("env.timeout", 0.0),
    ("network.torso", "resnet"),
    ("network.dense", -1),
    ("network.lstm", 0),
    ("network.lstm", 10**9),
    ("network.normalization", "batch"),
    ("learner.rollout_length", 1),
    ("learner.num_minibatches", 0),
    ("learner.num_minibatches", 5),
    ("learner.num_epochs", 0),
    ("learner.clip_ratio", 0.0),
    ("learner.learning_rate", 0.0),
    ("learner.learning_rate", float("nan")),
    ("learner.full_rate_inputs", 0),
    ("learner.warmup_updates", -1),
    ("learner.schedule", "cosine"),
    ("learner.adam_b1", 1.0),
    ("learner.adam_b2", -0.1),
    ("learner.adam_eps", 0.0),
    ("learner.max_grad_norm", 0),
    ("learner.reduction", "max"),
    ("learner.value_weight", -1.0),
    ("learner.vision_weight", float("inf")),
    ("learner.vision_bootstrap", "other"),
    ("learner.vision_bootstrap", "literal"),  # of n-step returns only
    ("learner.natural.gamma", 1.01),
    ("learner.natural.gae_lambda", -0.01),
    ("learner.vision.gamma", -1),
    ("learner.vision.entropy_weight", -0.5),
    ("train.env_steps", 0),
    ("train.env_steps", 10**15),
    ("train.dump_skipped", 1),
    ("train.log_every", 0.0),
    ("train.logger", "tensorboard"),
    ("train.checkpoint_every", -1.0),
    ("train.keep_checkpoints", 0),
    ("train.max_skipped", 0),
]


@pytest.mark.parametrize(("key", "value"), OUT_OF_RANGE)
def test_a_value_out_of_range_is_refused_by_name(key, value):
    message = error(changed(RINGS, tuple(key.split(".")), value))
    assert key in message and "accepted is" in message


@pytest.mark.parametrize(
    ("key", "value"), [("rings", 1), ("wedges", 3), ("fovea", 0.0), ("radius", 3.0), ("sampling", "max")]
)
def test_a_log_polar_value_out_of_range_is_refused_by_name(key, value):
    message = error(changed(LOG_POLAR, ("sensor", key), value))
    assert message.startswith(f"sensor.{key}=") and "accepted is" in message


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("seed", 0),
        ("sensor.rings", [[80, 79, 79]]),
        ("sensor.rings", [[30, 50, 1], [30, 51, 3]]),
        ("sensor.peripheral", [80, 80]),
        ("gaze.start", [0, 79]),
        ("gaze.start", "random"),
        ("gaze.actions", 9),
        ("env.sticky_actions", 0),
        ("env.noop_max", 0),
        ("network.dense", 0),
        ("learner.num_minibatches", 32),
        ("train.env_steps", 2048 * (2**31 // 64 - 2)),  # rollouts of 64 steps, counted in 32 bits
        ("learner.clip_ratio", 0.2),
        ("learner.max_grad_norm", None),
        ("learner.natural.gamma", 1),
        ("run", "elsewhere/run-1"),
    ],
)
def test_a_value_at_the_edge_is_taken(key, value):
    path = tuple(key.split("."))
    section = to_mapping(from_mapping(changed(RINGS, path, value)))
    for name in path:
        section = section[name]
    assert section == value


def test_a_window_larger_than_the_frame_needs_a_gaze_that_bounds_the_point_alone():
    wide = changed(LOG_POLAR, ("sensor", "radius"), 60.0)
    wide["gaze"]["bounds"] = "window"
    assert error(wide).startswith("sensor.radius=")
    wide["gaze"]["bounds"] = "point"
    assert from_mapping(wide).sensor.window == (120, 120)


def test_bounds_fovea_need_a_finest_part_inside_the_frame_that_can_move():
    wide = changed(LOG_POLAR, ("sensor", "radius"), 60.0)
    wide["gaze"]["bounds"] = "fovea"
    assert from_mapping(wide).sensor.finest == (6, 6)
    wide["sensor"]["fovea"] = 45.0
    assert error(wide).startswith("gaze.bounds=fovea: the finest part of sensor.radius, [90, 90], exceeds")
    full = changed(RINGS, ("gaze", "bounds"), "fovea")
    full["sensor"]["rings"] = [[80, 80, 1]]
    assert error(full).startswith("gaze.bounds=fovea: the focal area of sensor.rings fills")


@pytest.mark.parametrize("config", [RINGS, LOG_POLAR], ids=lambda config: config.name)
def test_to_mapping_is_plain_and_the_inverse_of_from_mapping(config):
    mapping = json.loads(json.dumps(to_mapping(config)))
    assert from_mapping(mapping) == config
    assert to_mapping(from_mapping(mapping)) == mapping


def test_a_config_cannot_be_changed():
    with pytest.raises(AttributeError):
        RINGS.seed = 1


@pytest.mark.parametrize("config", [RINGS, LOG_POLAR], ids=lambda config: config.name)
def test_a_config_is_a_key_of_a_mapping_wherever_it_comes_from(config):
    for same in (pickle.loads(pickle.dumps(config)), copy.deepcopy(config), from_mapping(to_mapping(config))):
        assert {config: 1}[same] == 1
    with pytest.raises(TypeError):
        config.env.crop_top["pong"] = 30


def test_a_section_with_other_values_is_checked_again():
    assert replace(RINGS.gaze, step=8) == GazeConfig(step=8)
    with pytest.raises(ConfigError, match="^gaze.step=0: accepted is an integer from 1 to 10000, or a rising list"):
        replace(RINGS.gaze, step=0)
    with pytest.raises(ConfigError, match="^seed=-1: accepted is "):
        replace(RINGS, seed=-1)


def test_a_section_takes_its_first_keys_by_place():
    assert RingSensor([[8, 8, 1]]) == RingSensor(rings=((8, 8, 1),))
    with pytest.raises(TypeError):
        GazeConfig("learned", 5, 4, "point", "centre", (), "steps", (5, 5), 0.0, "pixel", 7)


NEAREST = [
    ("learner.num_epoch", "learner.num_epochs"),
    ("sed", "seed"),
    ("gaze.moode", "gaze.mode"),
    ("frame_skip", "env.frame_skip"),  # without its section
    ("learner.gamma", "learner.natural.gamma"),
]


@pytest.mark.parametrize("near, word", NEAREST)
def test_the_nearest_key_is_suggested(near, word):
    said = error(changed(RINGS, near.split("."), 1))
    assert said.startswith(f"{near}=1: unknown key (did you mean {word}?); accepted is one of ")


@pytest.mark.parametrize("key", [key for group in groups(Config) for key in group.keys], ids=lambda key: key.name)
def test_every_key_has_a_sentence(key):
    assert key.sentence[0].isupper() and key.sentence.endswith(".") and key.sentence.count(". ") == 0


@pytest.mark.parametrize(
    ("game", "run", "expected"),
    [
        ("breakout", None, "runs/breakout-constant70-s3"),
        ("gymnasium:ALE/Pong-v5", None, "runs/gymnasium-ALE-Pong-v5-constant70-s3"),
        ("breakout", "here", "here"),
    ],
)
def test_the_run_directory_is_named_after_the_run(game, run, expected):
    assert replace(RINGS, game=game, run=run, seed=3).run_dir == expected
