"""Trained agents: found by name, deciding frame by frame, and running no code that only their configuration names."""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
import sys
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
import yaml
from safetensors.numpy import save_file

from foajax import cli, evaluate, player
from foajax.config.parse import ConfigError, replace, to_mapping
from foajax.config.shipped import agents
from foajax.reporting.curves import read_run
from foajax.runs.agents import begin_from, load_agent, save_agent
from foajax.runs.directory import load_config
from foajax.types import TimeStep, TrainState

PONG = "pong-constant70_p_packed"
BEFORE = Path(__file__).parents[1] / "data" / "shipped_before"
VALUES = [[-0.02670, 0.28586], [0.09523, -0.00696], [-0.27053, -0.12366], [-0.23351, 0.48221], [0.31303, -0.21762]]
NAMED = {
    "game": "evil:game",
    "sensor": {"kind": "evil:Sensor", "kwargs": {}},
    "network.torso": "evil:Torso",
    "network.core": "evil:Core",
}


@pytest.fixture(scope="module")
def pong():
    return load_agent(PONG)


@pytest.fixture(params=NAMED)
def strange(request, tmp_path, monkeypatch):
    """A stranger's agent, whose configuration names code that writes a file where it is imported."""
    (tmp_path / "evil.py").write_text(f"import pathlib\npathlib.Path({str(tmp_path / 'ran')!r}).touch()")
    monkeypatch.syspath_prepend(tmp_path)
    shutil.copytree(agents() / PONG, tmp_path / "agent")
    file = tmp_path / "agent" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    group, _, key = request.param.rpartition(".")
    (config[group] if group else config)[key] = NAMED[request.param]
    file.write_text(yaml.safe_dump(config))
    yield tmp_path / "agent"
    sys.modules.pop("evil", None)


def test_loading_runs_no_code_that_only_the_configuration_names(strange, capsys):
    refused = r"it would run the code [\w.]+=evil:\w+; accepted is trust=true if you trust its author"
    for read in (load_agent, read_run):
        with pytest.raises(ConfigError, match=refused):
            read(strange)
    for command in (evaluate.evaluate, player.player):
        assert cli.run(command, [f"run={strange}", f"out={strange}/out"][: 1 + (command is player.player)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 2 and error.count("trust=true") == 2
    assert not (strange.parent / "ran").exists()


def test_an_agents_logger_is_nobodys_business(pong, tmp_path):
    """It needs no trust, since nothing imports it, and a shipped agent does not have it."""
    config = pong.agent.config
    train = replace(config.train, logger="no_such_module:Logger", logger_kwargs={"key": "secret"})
    logged = dataclasses.replace(pong, agent=dataclasses.replace(pong.agent, config=replace(config, train=train)))
    save_agent(logged, tmp_path / "agent")
    assert load_config(tmp_path / "agent").train == config.train
    file = tmp_path / "agent" / "config.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | {"train": to_mapping(train)}))
    assert load_agent(tmp_path / "agent").agent.config.train.logger == "no_such_module:Logger"


@pytest.mark.parametrize("strange", ["sensor", "network.torso", "network.core"], indirect=True)
def test_with_trust_it_runs(strange):
    with pytest.raises(ConfigError, match=r"evil:\w+: module 'evil' has no .*; accepted is package.module:Name"):
        load_agent(strange, trust=True)
    assert (strange.parent / "ran").exists()


@pytest.mark.parametrize("strange", ["sensor", "network.torso", "network.core"], indirect=True)
def test_a_run_begins_from_an_agent_with_the_code_that_its_own_words_name(strange, pong):
    state = TrainState(None, None, pong.statistics, None, None)
    with pytest.raises(ConfigError, match=f"train.init_from={strange}: .*trust=true"):
        begin_from(str(strange), state, pong.agent.config)
    assert not (strange.parent / "ran").exists()
    with pytest.raises(ConfigError, match=f"train.init_from={strange}: .*evil:.* has no"):
        begin_from(str(strange), state, load_config(strange))
    assert (strange.parent / "ran").exists()


def test_a_shipped_agent_is_found_by_its_name_from_any_directory(pong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / PONG / "render").mkdir(parents=True)  # a directory that holds no agent does not hide it
    assert load_agent(PONG).env_steps == pong.env_steps > 0
    with pytest.raises(ConfigError, match="run=no-such-agent: does not exist"):
        load_agent("no-such-agent")


def screens(seed, batch=2):
    return np.random.default_rng(seed).integers(0, 255, (batch, 210, 160)).astype(np.uint8)


def test_an_agent_that_was_shipped_before_decides_as_it_did(tmp_path):
    """Configuration and shapes are those of Pong's first agent, `VALUES` from the code that shipped it (375e4e9)."""
    shapes = json.loads((BEFORE / "shapes.json").read_text())
    rng = np.random.default_rng(0)
    arrays = {name: np.asarray(rng.normal(0, 0.1, shape), np.float32) for name, shape in shapes.items()}
    statistics = {"1/weight": 1.0, "1/mean": 0.3, "1/std": 0.2}
    arrays |= {name: np.array(value, np.float32) for name, value in statistics.items()}
    shutil.copytree(BEFORE, tmp_path / "agent")
    save_file(arrays, tmp_path / "agent" / "agent.safetensors")
    before = load_agent(tmp_path / "agent")
    state, values = before.agent.initial_state(2), []
    for t in range(len(VALUES)):
        timestep = TimeStep(screens(t), np.zeros(2, np.float32), np.array([t == 0, t in (0, 3)]), np.zeros(2, bool))
        key = jax.random.key(t)
        _, output, state = before.agent.act(before.params, before.statistics, state, timestep, key, greedy=True)
        values.append(output.natural_value)
    np.testing.assert_allclose(values, VALUES, atol=1e-5)
    assert state.focal_point.tolist() == [[36, 40], [40, 40]]


@pytest.mark.parametrize("greedy", [True, False])
def test_it_decides_as_the_pure_agent_does(pong, greedy):
    pong.reset(2, seed=5, greedy=greedy)
    act = jax.jit(functools.partial(pong.agent.act, greedy=greedy))
    state, rewards = pong.agent.initial_state(2), np.array([0.0, 1.0], np.float32)
    for t, is_first in enumerate(([True, True], [False, False], [False, True])):
        timestep = TimeStep(screens(t), rewards, np.array(is_first), np.zeros(2, bool))
        key = jax.random.fold_in(jax.random.key(5), t)
        output, _, state = act(pong.params, pong.statistics, state, timestep, key)
        actions = pong.decide(screens(t), rewards, starts=np.array(is_first) if t else None)
        expected = (output.natural_action, output.vision_action, output.focal_point)
        chex.assert_trees_all_equal(tuple(actions), jax.tree.map(np.asarray, expected))


def test_a_reset_compiles_nothing_anew(pong):
    pong.reset(2)
    pong.decide(screens(0))
    program, compiled = pong.act, pong.act._cache_size()
    pong.reset(2, seed=1)
    pong.decide(screens(1))
    assert pong.act is program and pong.act._cache_size() == compiled


def test_it_begins_by_itself_and_says_what_it_cannot_take(pong):
    fresh = load_agent(PONG)
    assert fresh.decide(screens(0, 3)).natural.shape == (3,)
    with pytest.raises(ValueError, match=r"frames=\[2, 210, 160\]: accepted is \[3, ...\], as reset\(3\) was told"):
        fresh.decide(screens(0))
    with pytest.raises(ValueError, match=r"frame=uint8 \[3, 80, 80\]: accepted is uint8 \[B, 210, 160\], gray"):
        fresh.decide(np.zeros((3, 80, 80), np.uint8))
    for more in ({"rewards": np.array(1.0)}, {"rewards": np.zeros(2)}, {"starts": np.array([True])}):
        with pytest.raises(ValueError, match=rf"{next(iter(more))}=\[\d?\]: accepted is \[3\], one for each frame"):
            fresh.decide(screens(0, 3), **more)
