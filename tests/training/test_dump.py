"""The batch of an update that was not finite: written once its metrics are looked at, as it was when it was used."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops import VIEW, Loop
from safetensors import safe_open
from safetensors.numpy import load_file

from foajax.runs.agents import named
from foajax.training.dump import Dump


@pytest.fixture(scope="module")
def seek():
    loop = Loop("game=seek", *VIEW)
    loop.run(1)
    return loop


@pytest.fixture
def told():
    return []


def spoilt(rollout, environment):
    """A copy with a reward that is no number."""
    rollout = jax.tree.map(jnp.copy, rollout)
    return rollout._replace(steps=rollout.steps._replace(reward=rollout.steps.reward.at[3, environment].set(jnp.nan)))


def update(loop, rollout):
    """Every minibatch of a rollout; returns the metrics."""
    rows = []
    for index in range(2):
        loop.state, row = loop.programs.update(loop.state, rollout, np.int32(index), np.bool_(True))
        rows.append(row)
    return rows


def test_the_file_has_what_the_update_had(seek, tmp_path, told):
    dump = Dump(tmp_path / "skipped", minibatches=2, warn=told.append)
    (rollout,), _ = seek.collect()
    bad = spoilt(rollout, 5)
    expected = jax.tree.map(np.array, (seek.state.params, bad))
    dump.remember(4800, seek.state.params, [bad])
    rows = update(seek, bad)
    bad = jax.tree.map(lambda x: x.delete(), bad)  # as the next rollout overwrites it
    seek.collect()
    dump.look(rows)
    (path,) = (tmp_path / "skipped").iterdir()
    assert told == [f"skipped an update that was not finite; its batch is in {path}"]
    with safe_open(path, "numpy") as file:
        facts = file.metadata()
    # Every second environment from 1 on is in the second of two minibatches.
    assert facts == {"env_steps": "4800", "epoch": "0", "group": "0", "minibatch": "1"}
    arrays = load_file(path)
    assert np.isnan(arrays["rollout/steps/reward"][3, 5])
    chex.assert_trees_all_equal(arrays, named(dict(zip(("params", "rollout"), expected, strict=True))))
    loss, _ = seek.loss(jax.tree.map(jnp.asarray, expected[0]), jax.tree.map(jnp.asarray, expected[1]))
    assert np.isnan(loss)


def test_the_first_of_a_row_is_enough_and_five_files_are(seek, tmp_path, told):
    dump = Dump(tmp_path / "skipped", minibatches=2, warn=told.append)
    for env_steps in range(20):
        (rollout,), _ = seek.collect()
        dump.remember(env_steps, seek.state.params, [rollout])
        dump.look(update(seek, spoilt(rollout, 2) if env_steps % 2 else rollout))
    assert len(told) == len(list((tmp_path / "skipped").iterdir())) == 5
    assert sorted(path.name for path in (tmp_path / "skipped").iterdir())[0] == "1-0.safetensors"


def test_a_dump_that_cannot_be_written_ends_nothing(seek, tmp_path, told):
    (tmp_path / "skipped").touch()
    dump = Dump(tmp_path / "skipped", minibatches=2, warn=told.append)
    (rollout,), _ = seek.collect()
    dump.remember(0, seek.state.params, [rollout])
    dump.look(update(seek, spoilt(rollout, 1)))
    assert len(told) == 1 and "was not written" in told[0]
