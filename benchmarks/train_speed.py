"""How fast does training run, against the emulator alone?

    python benchmarks/train_speed.py [experiments=constant70_packed,nonfoa] [torso=a3c] [learner=default] [out=<file>]

For each experiment, a process of its own times four parts: the environments alone under random actions, `act` alone,
`update` alone, and the training loop. They take turns of a few seconds, `repeats` times. Medians of steps/s are printed
and written. `ratio` is the median of end_to_end / env_only, both of one turn. `core_us` is processor time per step over
all cores. Further words, such as `learner.num_epochs=2`, go to the configuration. Run it on an idle machine.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from foajax import cli
from foajax.config.compose import compose
from foajax.config.schema import Config
from foajax.envs.base import Environment
from foajax.envs.make import make_environments
from foajax.learning.agent import Agent
from foajax.learning.programs import make_programs, make_state
from foajax.reporting import bench
from foajax.runtime import keep_memory, use_compilation_cache
from foajax.training.collector import Collector, update_on

PARTS = ("env_only", "act_only", "update_only", "end_to_end")


class Options(bench.Options):
    experiments: str = Field(
        "nonfoa,constant70,constant70_packed,constant70_p_packed,decreasing_packed,logpolar",
        description="Names with commas between them.",
    )
    torso: str = Field("nature", description="Choice of the group network/.")
    learner: str = Field("a2c", description="Choice of the group learner/; a2c makes one pass over each step.")
    num_envs: int = Field(32, ge=1, description="Environments.")
    repeats: int = Field(5, ge=1, description="Turns of each part.")
    seconds: float = Field(3.0, gt=0, description="Seconds per turn of one part.")
    startup: bool = Field(True, description="Also time a whole process up to its first update.")


class Bench:
    """The parts of one experiment: each call makes `steps` steps and returns when they are done."""

    def __init__(self, config: Config, resources: contextlib.ExitStack) -> None:
        self._learner = config.learner
        self._environments = make_environments(config, 0)
        self._alone = make_environments(config, 1)
        for environment in [*self._environments, *self._alone]:
            resources.callback(environment.close)
        agent = Agent(config, self._environments[0].num_actions, self._environments[0].crop_top)
        self._programs = make_programs(agent)
        self._collector = Collector(agent, self._programs, self._environments, seed=config.seed)
        self._state = make_state(agent, config.seed)
        self._random = np.random.default_rng(0)
        for environment in self._alone:
            environment.reset()
            self._send_random(environment)
        self._step = 0
        self._metrics: list = []
        self.steps = config.env.num_envs * config.learner.rollout_length

    def env_only(self) -> None:
        """Steps only the environments, with random actions, each as soon as its last step is received."""
        for _ in range(self._learner.rollout_length):
            for environment in self._alone:
                environment.recv()
                self._send_random(environment)

    def act_only(self) -> None:
        """Makes a rollout's decisions, all upon the same time step."""
        self._collector.decide(self._state, self._step)

    def update_only(self) -> None:
        """Makes all updates of a rollout."""
        rollouts = [group.rollout for group in self._collector.groups]
        self._state, metrics = update_on(rollouts, self._state, self._programs, self._learner)
        jax.block_until_ready(metrics)

    def end_to_end(self) -> None:
        """Collects a rollout and starts its updates; as in training, the next rollout does not wait for them."""
        rollouts, _ = self._collector.collect(self._state, self._step)
        jax.device_get(self._metrics)
        self._state, self._metrics = update_on(rollouts, self._state, self._programs, self._learner)
        self._step += self._learner.rollout_length

    def _send_random(self, environment: Environment) -> None:
        actions, batch = environment.num_actions, environment.num_envs
        environment.send(self._random.integers(actions, size=batch, dtype=np.int32))


def measure(words: Sequence[str], options: Options) -> dict[str, Any]:
    """Measures one experiment; returns its record."""
    use_compilation_cache()
    keep_memory()
    config = compose(words)
    with contextlib.ExitStack() as resources:
        subject = Bench(config, resources)
        calls = {part: getattr(subject, part) for part in PARTS}
        for call in reversed(calls.values()):  # compiles; end_to_end first, so that there is a rollout to learn from
            call()
        turns: dict[str, list[tuple[float, float]]] = {part: [] for part in PARTS}
        for _ in range(options.repeats):
            for part, call in calls.items():
                turns[part].append(_turn(call, subject.steps, options.seconds))
    record: dict[str, Any] = {
        "experiment": config.name,
        "torso": config.network.torso,
        "learner": options.learner,
        "num_envs": config.env.num_envs,
        "groups": config.env.num_groups,
    }
    record |= {part: statistics.median(speed for speed, _ in turns[part]) for part in PARTS}
    ratios = [whole / env for (whole, _), (env, _) in zip(turns["end_to_end"], turns["env_only"], strict=True)]
    record |= {"ratio": statistics.median(ratios), "ratio_min": min(ratios), "ratio_max": max(ratios)}
    record["core_us"] = {part: statistics.median(core for _, core in turns[part]) for part in PARTS}
    record["peak_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return record


def _turn(call: Callable[[], None], steps: int, seconds: float) -> tuple[float, float]:
    """Repeats a call for `seconds`; returns steps/s, and microseconds of processor time per step."""
    count, begin, busy = 0, time.perf_counter(), time.process_time()
    while (taken := time.perf_counter() - begin) < seconds or count == 0:
        call()
        count += 1
    return count * steps / taken, 1e6 * (time.process_time() - busy) / (count * steps)


def startup(words: Sequence[str], config: Config) -> float:
    """Times a training process of one rollout, its updates and a checkpoint, with a filled compilation cache."""
    steps = config.env.num_envs * config.learner.rollout_length
    seconds = 0.0
    for _ in range(2):  # the first one fills the compilation cache
        with tempfile.TemporaryDirectory() as directory:
            words_of_run = [*words, f"train.env_steps={steps}", f"run={directory}/run"]
            begin = time.perf_counter()
            subprocess.run([sys.executable, "-m", "foajax.train", *words_of_run], check=True, stdout=subprocess.DEVNULL)
            seconds = time.perf_counter() - begin
    return seconds


def main(arguments: Sequence[str]) -> None:
    keys = Options.model_fields.keys()
    options = cli.parse(Options, [word for word in arguments if word.partition("=")[0] in keys])
    more = [word for word in arguments if word.partition("=")[0] not in keys]
    runs = []  # composed before the first is measured, so that a mistake in the last one loses nothing
    for name in options.experiments.split(","):
        groups = [f"experiment={name}", f"network={options.torso}", f"learner={options.learner}"]
        words = [*groups, f"env.num_envs={options.num_envs}", *more]
        runs.append((words, compose(words)))
    device = jax.devices()[0].device_kind
    print(f"device {device}", flush=True)
    records = []
    for words, config in runs:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            record = pool.apply(measure, (words, options))
        if options.startup:
            record["startup_seconds"] = startup(words, config)
        records.append(record | {"device": device})
        print(_line(record), flush=True)
    _print(records)
    if options.out:
        bench.write("out", options.out, records, ["python", "benchmarks/train_speed.py", *arguments])


def _line(record: dict[str, Any]) -> str:
    speeds = "  ".join(f"{part} {record[part]:,.0f}" for part in PARTS)
    return f"  {record['experiment']:22} {speeds}  ratio {record['ratio']:.2f}"


def _print(records: Sequence[dict[str, Any]]) -> None:
    table = Table(title="steps/s (core microseconds per step)")
    for heading in ("experiment", "torso", "envs", *PARTS, "ratio (min-max)", "MB", "start s"):
        table.add_column(heading, justify="left" if heading in ("experiment", "torso") else "right")
    for record in records:
        table.add_row(
            record["experiment"],
            record["torso"],
            str(record["num_envs"]),
            *(f"{record[part]:,.0f} ({record['core_us'][part]:,.0f})" for part in PARTS),
            f"{record['ratio']:.2f} ({record['ratio_min']:.2f}-{record['ratio_max']:.2f})",
            f"{record['peak_memory_mb']:,.0f}",
            f"{record['startup_seconds']:.1f}" if "startup_seconds" in record else "",
        )
    Console(width=150).print(table)


if __name__ == "__main__":
    sys.exit(cli.run(main))
