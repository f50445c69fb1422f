"""One training run: its parts wired together, and the loop."""

from __future__ import annotations

import contextlib
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from foajax.config.parse import ConfigError, refuse
from foajax.config.schema import Config
from foajax.envs.base import Environment
from foajax.envs.make import make_environments
from foajax.launch.processes import Job, PeerWatch
from foajax.launch.signals import StopRequest
from foajax.learning.agent import Agent
from foajax.learning.learner import Metrics
from foajax.learning.programs import make_programs, make_state
from foajax.learning.sharding import Layout
from foajax.runs.agents import begin_from, save_facts
from foajax.runs.directory import RunDir, note_failure
from foajax.runs.logger import Logger
from foajax.runs.row_logger import find_logger
from foajax.training.collector import ROLLOUTS_TO_OBSERVE, Collector, update_on
from foajax.training.dump import Dump
from foajax.training.episodes import EpisodeTracker
from foajax.training.journal import Journal, check_finite
from foajax.training.saving import Progress, Saving
from foajax.training.watchdog import Watchdog, report_fault
from foajax.types import Outcome, TrainState

_PICTURES_EVERY = 900.0  # seconds


class Run:
    """The parts of one run, at the point where its newest checkpoint left it.

    Processes that share a run all act and learn. Only the first has the directory, writes and prints.
    """

    def __init__(self, config: Config, job: Job, run_dir: RunDir | None, resources: contextlib.ExitStack) -> None:
        self._config, self._job, self._journal = config, job, Journal()
        self._layout = Layout(job.devices, job.local_devices) if len(job.devices) > 1 else None
        self._saving = Saving(config, job, self._layout, run_dir, self._journal.warn)
        env_steps = int(job.broadcast_text("saved", str(self._saving.newest())))
        self.progress = Progress(env_steps, EpisodeTracker(config.env.num_envs))
        self._stop_agreed = False  # by several processes, which stop after the same rollout
        self._has_said_end = False
        environments = self._make_environments(resources)
        self._agent = Agent(config, environments[0].num_actions, environments[0].crop_top)
        self._programs = make_programs(self._agent, self._layout)
        self._collector = Collector(self._agent, self._programs, environments, seed=config.seed, part=job.index)
        self._watch = PeerWatch(job, config.distributed.timeout, self._saving.rescue)
        with self._watch.expecting_others():
            self.progress.state = self._first_state()
            self._saving.restore(self.progress, self._collector)
        is_new = not self.progress.env_steps and config.train.init_from is None
        self._to_observe = ROLLOUTS_TO_OBSERVE if is_new else 0
        self._dump = self._open(run_dir, resources)

    def _make_environments(self, resources: contextlib.ExitStack) -> list[Environment]:
        """Makes this process's environments, watched. A resumed run has other seeds: emulators cannot be saved."""
        watchdog = Watchdog(
            self._config.env.timeout,
            abandon=self._abandon,
            is_saved=lambda: self._saving.is_saved(self.progress),
            alone=self._job.count == 1,
        )
        resources.enter_context(watchdog)
        make = watchdog.watched("making the environments", make_environments, patience=10.0)  # emulators load slowly
        environments = make(self._config, self.progress.env_steps, self._job.index, self._job.count)
        for group, environment in enumerate(environments):
            watchdog.watch(environment, f"environment group {group}")
            resources.callback(environment.close)
        return environments

    def _first_state(self) -> TrainState:
        """Makes the first state, with the parameters of `train.init_from` if that is set, on all devices."""
        config, job = self._config, self._job
        state = make_state(self._agent, config.seed)
        if (path := config.train.init_from) is not None and not self.progress.env_steps:
            begun = job.run_on_first("parameters", lambda: begin_from(path, state, config))
            state = job.broadcast(state if begun is None else begun)
        return self._layout.replicate(state) if self._layout else state

    def _open(self, run_dir: RunDir | None, resources: contextlib.ExitStack) -> Dump | None:
        """Opens the files that the run writes, and says how it starts; returns what keeps skipped batches, or None."""
        config, env_steps = self._config, self.progress.env_steps
        if run_dir is None or self._saving.checkpoints is None:
            self._journal.write_to(None)
            return None
        save_facts(self._agent, run_dir.path)
        total, other = config.train.env_steps, find_logger(config)
        logger = Logger(run_dir.path, total_env_steps=total, start_env_steps=env_steps, other=other)
        self._journal.write_to(resources.enter_context(logger))
        resources.enter_context(self._saving.checkpoints)
        self._journal.say(f"{run_dir.path}: {self._how_it_starts()}")
        if not config.train.dump_skipped:
            return None
        return Dump(run_dir.path / "skipped", minibatches=config.learner.num_minibatches, warn=self._journal.warn)

    def loop(self, stop: StopRequest) -> None:
        """Collects and updates until `train.env_steps` or a request to stop; saves in the end, whatever ends it."""
        try:
            with self._watch.expecting_others():
                self._loop(stop)
        finally:
            self._watch.rest()
            self._saving.finish(self.progress)
        if not self._saving.is_saved(self.progress):
            raise ConfigError(self._unsaved())
        asked = stop.name or ("a signal to another process" if self._stop_agreed else None)
        self._journal.say(self._how_it_ends(asked))
        self._has_said_end = True

    def _loop(self, stop: StopRequest) -> None:
        config, at = self._config, self.progress
        logged = saved = time.monotonic()
        pictured = -math.inf
        metrics: list[Metrics] = []
        while at.env_steps < config.train.env_steps and not self._is_to_stop(stop):
            if self._job.count > 1:
                if metrics:  # nothing is left to compile
                    self._watch.beat()
                self._saving.refresh_copy(at)
            own, outcomes = self._collector.collect(self._nearby(at.state), self._step())
            outcomes, games = self._exchange(outcomes, stop)
            # Fetched one rollout late: by now they are there, and nothing waits for the device.
            self._check(metrics)
            self._track(outcomes)
            now = time.monotonic()
            if metrics and now - logged >= config.train.log_every:
                self._log(metrics)
                logged = now
            if self._dump:
                self._dump.remember(at.env_steps, at.state.params, own)
            rollouts = [self._layout.join(rollout) for rollout in own] if self._layout else own
            if self._to_observe:
                for rollout in rollouts:
                    at.state = self._programs.observe(at.state, rollout)
                self._to_observe -= 1
                continue
            at.state, metrics = update_on(rollouts, at.state, self._programs, config.learner)
            at.env_steps += config.env.num_envs * config.learner.rollout_length
            at.games = games
            if now - pictured >= _PICTURES_EVERY:
                self._journal.picture(own[0], config.env.frame_shape)
                pictured = now
            if now - saved >= config.train.checkpoint_every:
                self._saving.save(at)
                saved = now
        self._check(metrics)
        if metrics:
            self._log(metrics)

    def _is_to_stop(self, stop: StopRequest) -> bool:
        """Whether to stop. Several processes stop after the same rollout, because each waits for the others in it."""
        return stop.name is not None if self._job.count == 1 else self._stop_agreed

    def _step(self) -> int:
        """Returns how many steps each environment has made, below 0 while a run observes; it seeds the sampling."""
        observing = self._to_observe * self._config.learner.rollout_length
        return self.progress.env_steps // self._config.env.num_envs - observing

    def _exchange(
        self, outcomes: list[list[Outcome]], stop: StopRequest
    ) -> tuple[list[list[Outcome]], list[dict[str, Any]]]:
        """Gathers what processes tell each other after a rollout: their outcomes, games and requests to stop."""
        games = self._collector.get_state()
        if self._job.count == 1:
            return outcomes, games
        stacked = [Outcome(*(np.stack(field, axis=1) for field in zip(*group, strict=True))) for group in outcomes]
        told = {"outcomes": stacked, "games": games, "stop": np.array([stop.name is not None])}
        told = self._job.gather(told)
        self._stop_agreed = bool(told["stop"].any())
        steps = [[Outcome(*step) for step in zip(*(f.T for f in group), strict=True)] for group in told["outcomes"]]
        return steps, told["games"]

    def _track(self, outcomes: list[list[Outcome]]) -> None:
        for step in zip(*outcomes, strict=True):
            self.progress.tracker.add(Outcome(*(np.concatenate(field) for field in zip(*step, strict=True))))

    def _nearby(self, state: TrainState) -> TrainState:
        """Returns the state with what acting needs of it on this process's devices."""
        if self._layout is None:
            return state
        params, statistics = self._layout.nearby((state.params, state.statistics))
        return state._replace(params=params, statistics=statistics)

    def _check(self, metrics: list[Metrics]) -> None:
        """Raises `ConfigError` if too many updates in a row were not finite; dumps skipped batches if asked to."""
        if not metrics:
            return
        if self._dump:
            self._dump.look(metrics)
        try:
            check_finite(metrics, self._config.train.max_skipped, self.progress.env_steps)
        except ConfigError:
            self._log(metrics)
            raise

    def _log(self, metrics: list[Metrics]) -> None:
        measures = self._collector.measures()
        self._journal.row(self.progress.env_steps, metrics, self.progress.tracker, measures, self._agent.num_actions)

    def _abandon(self, why: str, code: int) -> int:
        """Saves and reports in place of the main thread, which does not come back; returns the exit code."""
        self._saving.finish(self.progress)
        if code:
            report_fault(self._config, why, None)
        elif self._saving.is_saved(self.progress):
            if not self._has_said_end:  # it has where only closing the environments is slow
                self._journal.say(self._how_it_ends(why))
            return code
        else:
            why, code = self._unsaved(), 2
            self._journal.say(f"foajax: error: {why}")
        self._journal.leave_terminal()
        if self._saving.checkpoints is not None:
            note_failure(Path(self._config.run_dir), why)
        return code

    def _how_it_starts(self) -> str:
        if not self.progress.env_steps:
            parameters = self._config.train.init_from
            begins = f", from the parameters of {parameters}" if parameters else ""
            return f"new run of {self._config.name} on {self._config.game}{begins}"
        games = "episodes go on" if self._collector.resumable else "episodes start anew, emulators cannot be saved"
        return f"resumed at {self.progress.env_steps:,} env_steps ({games})"

    def _unsaved(self) -> str:
        reason = f"it was trained to {self.progress.env_steps:,} env_steps, but {self._saving.newest():,} are saved"
        return str(refuse("run", self._config.run_dir, "a directory that can be written", why=reason))

    def _how_it_ends(self, stop: str | None) -> str:
        if stop is None:
            return f"done: {self.progress.env_steps:,} env_steps"
        if not self.progress.env_steps:
            return f"{stop}: stopped before anything was learned; the same command begins anew"
        return f"{stop}: saved at {self.progress.env_steps:,} env_steps; the same command goes on from here"
