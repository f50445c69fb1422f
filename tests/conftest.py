"""What every test runs under: the CPU or JAX_PLATFORMS, checked shapes and types, no rank promotion, a cache."""

from __future__ import annotations

import logging
import os
import signal

# Before anything imports jax, and for the processes that tests start. Compilation is most of what tests cost, and what
# they compile runs but a few times: LLVM optimises nothing, in one piece, and XLA's older emitters are twice as fast.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters",
)

import jax
import noise
import processes
import pytest
from jaxtyping import install_import_hook

# Every function of the package checks its annotations, shapes included, while tests run. The hook only sees
# modules that are imported after it.
install_import_hook("foajax", "beartype.beartype")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config: pytest.Config) -> None:
    """Shares compiled programs, small ones too, between test runs, pytest's workers and the processes they start."""
    jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    for name in ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"):
        os.environ[name.upper()] = str(jax.config.values[name])
    logging.raiseExceptions = False  # absl may hold the stderr of an earlier test and say on ours that it is closed
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as behind a shell's `&`; what is ignored is inherited
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def no_process_is_left():
    """A test that fails would else leave its training to run beside all that follow."""
    yield
    while processes.STARTED:
        process = processes.STARTED.pop()
        if process.poll() is None:
            process.kill()
            process.communicate()  # closes its pipes: what is collected later is a later test's warning


@pytest.fixture
def command(capsys):
    """Trains in this process, which has imported what a new one would have to: exit code, stdout, stderr."""
    from foajax.launch import launch
    from foajax.train import train
    from foajax.training.start import check

    def finish(*words):
        return launch.run(train, words, check=check), *capsys.readouterr()

    return finish


@pytest.fixture(scope="session")
def untrained():
    """Makes an agent with parameters of noise."""
    from foajax.runs.agents import TrainedAgent

    def make(agent, env_steps=0):
        params = noise.params(agent.initial_params, jax.random.key(0))
        return TrainedAgent(agent, params, agent.initial_statistics(), env_steps)

    return make


@pytest.fixture(scope="session")
def breakout_agent(untrained):
    """A small agent for Breakout that has learned nothing."""
    from foajax.config.compose import compose
    from foajax.learning.agent import Agent

    words = ["sensor=decreasing_p_packed", "name=small", "network.dense=16", "network.lstm=16", "gaze.bounds=point"]
    return untrained(Agent(compose(words), num_actions=4, crop_top=34))


@pytest.fixture(scope="session")
def recording(breakout_agent):
    """The first decisions of a game of Breakout on the real emulator."""
    from foajax.viewing.recording import record

    return next(record(breakout_agent, seed=0, max_steps=130))
