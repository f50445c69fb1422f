"""One training run: its parts wired together, the loop, and what is saved of it."""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from foajax.config.parse import ConfigError, refuse
from foajax.config.schema import Config
from foajax.envs.atari import is_atari
from foajax.envs.base import Environment
from foajax.envs.make import make_environments
from foajax.launch.processes import Job, Watch
from foajax.launch.signals import StopRequest
from foajax.learning.agent import Agent
from foajax.learning.learner import Metrics, explained_variance
from foajax.learning.programs import make_programs, make_state
from foajax.learning.sharding import Layout
from foajax.runs.agents import CHECKPOINTS, begin_from, save_facts
from foajax.runs.checkpoints import Checkpoints
from foajax.runs.directory import RunDir, note_failure, take_over
from foajax.runs.logger import Logger
from foajax.training.collector import ROLLOUTS_TO_OBSERVE, Collector, update_on
from foajax.training.dump import Dump
from foajax.training.episodes import EpisodeTracker
from foajax.training.watchdog import Watchdog, report_fault
from foajax.types import Outcome, Rollout, TrainState
from foajax.viewing.previews import snapshots

_PICTURES_EVERY = 900.0  # seconds
_GAMES_FOR_A_SCORE = 100  # the mean of fewer does not tell which checkpoint is best


class Run:
    """One run's parts, wired together, at the point where its newest checkpoint left it.

    Processes that share a run all act and learn; the first of them has the directory, and alone writes and speaks.
    """

    def __init__(self, config: Config, job: Job, run_dir: RunDir | None, resources: contextlib.ExitStack) -> None:
        self._config, self._job = config, job
        self._say = lambda text: print(text, file=sys.stderr, flush=True)  # until there is a logger
        self._rollout_steps = config.env.num_envs * config.learner.rollout_length
        self._checkpoints: Checkpoints | None = None
        self._logger: Logger | None = None
        self._dump: Dump | None = None
        if run_dir is not None:
            self._checkpoints = Checkpoints(
                run_dir.path / CHECKPOINTS, keep=config.train.keep_checkpoints, warn=self._warn
            )
        if run_dir is not None and config.train.dump_skipped:
            self._dump = Dump(run_dir.path / "skipped", minibatches=config.learner.num_minibatches, warn=self._warn)
        self._env_steps = int(job.tell("saved", str(self._newest())))
        self._games: list[dict[str, Any]] | None = None  # of all processes, as they were after the last update
        environments = self._make_environments(resources)
        agent = Agent(config, environments[0].num_actions, environments[0].crop_top)
        self._layout = Layout(job.devices, job.local_devices) if len(job.devices) > 1 else None
        self._programs = make_programs(agent, self._layout)
        self._collector = Collector(agent, self._programs, environments, seed=config.seed, part=job.index)
        self._tracker = EpisodeTracker(config.env.num_envs)
        state = make_state(agent, config.seed)
        if config.train.init_from is not None and not self._env_steps:
            path = config.train.init_from
            begun = job.by_first("parameters", lambda: begin_from(path, state, config))
            state = job.share(state if begun is None else begun)
        self._state = self._on_all_devices(state)
        self._stop_agreed = False
        self._kept: tuple[int, dict[str, Any], dict[str, Any]] | None = None
        self._kept_at = 0.0
        self._watch = Watch(job, config.distributed.timeout, self._rescue)
        with self._watch.expecting_others():
            self._restore()
        is_new = not self._env_steps and config.train.init_from is None
        self._to_observe = ROLLOUTS_TO_OBSERVE if is_new else 0
        if run_dir is None or self._checkpoints is None:
            self._say = lambda text: None
            return
        save_facts(agent, run_dir.path)
        self._logger = resources.enter_context(
            Logger(
                run_dir.path,
                total_env_steps=config.train.env_steps,
                start_env_steps=self._env_steps,
                frame_skip=config.env.frame_skip if is_atari(config) else 1,
            )
        )
        resources.enter_context(self._checkpoints)
        self._say = self._logger.message
        self._say(f"{run_dir.path}: {self._how_it_starts()}")

    def _make_environments(self, resources: contextlib.ExitStack) -> list[Environment]:
        """This process's, watched. Emulators cannot be saved: a resumed run plays new episodes, seeded by how far it
        got."""
        alone = self._job.count == 1
        watchdog = Watchdog(self._config.env.timeout, abandon=self._abandon, is_saved=self._is_saved, alone=alone)
        resources.enter_context(watchdog)
        make = watchdog.watched("making the environments", make_environments, patience=10.0)  # emulators load slowly
        environments = make(self._config, self._env_steps, self._job.index, self._job.count)
        for group, environment in enumerate(environments):
            watchdog.watch(environment, f"environment group {group}")
            resources.callback(environment.close)
        return environments

    def loop(self, stop: StopRequest) -> None:
        """Rollouts and updates until `train.env_steps` or a request to stop; saves in the end, whatever ends it."""
        try:
            with self._watch.expecting_others():
                self._loop(stop)
        finally:
            self._watch.rest()
            self._finish()
        if not self._is_saved():
            raise ConfigError(self._unsaved())
        self._say(self._how_it_ends(stop.name or ("a signal to another process" if self._stop_agreed else None)))

    def _loop(self, stop: StopRequest) -> None:
        train = self._config.train
        logged = saved = time.monotonic()
        pictured = -math.inf
        metrics: list[Metrics] = []
        while self._env_steps < train.env_steps and not self._is_to_stop(stop):
            self._keep(compiled=bool(metrics))
            step = self._env_steps // self._config.env.num_envs
            step -= self._to_observe * self._config.learner.rollout_length
            own, outcomes = self._collector.collect(self._nearby(self._state), step)
            outcomes, games = self._meet(outcomes, stop)
            # Fetched one rollout late: by now they are there, and nothing waits for the device.
            self._check(metrics)
            now = time.monotonic()
            if metrics and now - logged >= train.log_every:
                self._log(metrics)
                logged = now
            if self._dump:
                self._dump.remember(self._env_steps, self._state.params, own)
            rollouts = [self._layout.join(rollout) for rollout in own] if self._layout else own
            self._track(outcomes)
            if self._to_observe:
                for rollout in rollouts:
                    self._state = self._programs.observe(self._state, rollout)
                self._to_observe -= 1
                continue
            self._state, metrics = update_on(rollouts, self._state, self._programs, self._config.learner)
            if now - pictured >= _PICTURES_EVERY:
                self._picture(own[0])
                pictured = now
            self._env_steps += self._rollout_steps
            self._games = games
            if now - saved >= train.checkpoint_every:
                self._save()
                saved = now
        self._check(metrics)
        if metrics:
            self._log(metrics)

    def _is_to_stop(self, stop: StopRequest) -> bool:
        """Several processes stop after the same rollout, or the others would wait for the one that does not come."""
        return stop.name is not None if self._job.count == 1 else self._stop_agreed

    def _meet(
        self, outcomes: list[list[Outcome]], stop: StopRequest
    ) -> tuple[list[list[Outcome]], list[dict[str, Any]]]:
        """What all processes have to know of each other after a rollout: all outcomes, and the games as they stand."""
        games = self._collector.get_state()
        if self._job.count == 1:
            return outcomes, games
        stacked = [Outcome(*(np.stack(field, axis=1) for field in zip(*group, strict=True))) for group in outcomes]
        told = {"outcomes": stacked, "games": games, "stop": np.array([stop.name is not None])}
        told = self._job.gather(told)
        self._stop_agreed = bool(told["stop"].any())
        steps = [[Outcome(*step) for step in zip(*(f.T for f in group), strict=True)] for group in told["outcomes"]]
        return steps, told["games"]

    def _keep(self, *, compiled: bool) -> None:
        """Several processes: what is saved should one of them be lost, renewed now and then because it is a copy."""
        if self._job.count == 1:
            return
        if compiled:
            self._watch.beat()
        now, every = time.monotonic(), self._config.distributed.timeout / 20
        if self._kept is None or now - self._kept_at >= every:
            self._kept, self._kept_at = self._snapshot(), now

    def _rescue(self) -> str:
        if self._checkpoints is None and (run_dir := take_over(Path(self._config.run_dir))):
            self._checkpoints = Checkpoints(
                run_dir.path / CHECKPOINTS, keep=self._config.train.keep_checkpoints, warn=self._warn
            )
        if self._checkpoints is None:
            return "the first process saves what it can"
        if self._kept is None:
            return "nothing has been learned since the start"
        self._checkpoints.wait()
        self._checkpoints.save(*self._kept)
        self._checkpoints.wait()
        return f"saved at {self._newest():,} env_steps; the same command goes on from here"

    def _check(self, metrics: list[Metrics]) -> None:
        """Stops a run whose updates are not finite time after time."""
        if not metrics:
            return
        if self._dump:
            self._dump.look(metrics)
        most = self._config.train.max_skipped
        last = max(metrics, key=lambda each: int(each["skipped_in_a_row"]))
        if int(last["skipped_in_a_row"]) >= most:
            self._log(metrics)
            values = ", ".join(f"{name} {float(last[name]):.4g}" for name in ("loss", "grad_norm", "param_norm"))
            saved = f"the last good parameters are saved at {self._env_steps:,} env_steps"
            why = f"so many updates in a row were not finite ({values}); {saved}"
            accepted = "another run=<dir>, with a smaller learner.learning_rate or learner.max_grad_norm"
            raise refuse("train.max_skipped", most, accepted, why=why)

    def _track(self, outcomes: list[list[Outcome]]) -> None:
        for step in zip(*outcomes, strict=True):
            self._tracker.add(Outcome(*(np.concatenate(field) for field in zip(*step, strict=True))))

    def _picture(self, rollout: Rollout) -> None:
        if self._logger is not None:
            for tag, image in snapshots(rollout, self._config.env.frame_shape).items():
                self._logger.image(tag, image)

    def _log(self, metrics: list[Metrics]) -> None:
        if self._logger is None:
            return
        rows = jax.device_get(metrics)
        means = {name: finite_mean([row[name] for row in rows]) for name in rows[0] if name != "skipped_in_a_row"}
        self._logger.write(
            {
                "env_steps": self._env_steps,
                "games": self._tracker.games,
                "score": self._tracker.mean_score,
                "length": self._tracker.mean_length,
                "best_score": self._tracker.best_score,
                **explained_variance(means),
                "skipped_updates": rows[-1]["skipped_updates"],
            }
        )

    def _save(self) -> None:
        if self._checkpoints is not None:
            self._checkpoints.save(*self._snapshot())

    def _snapshot(self) -> tuple[int, dict[str, Any], dict[str, Any]]:
        """A checkpoint's env_steps, arrays and the rest."""
        meta: dict[str, Any] = {"tracker": self._tracker.get_state()}
        if self._tracker.games >= _GAMES_FOR_A_SCORE:
            meta["score"] = self._tracker.mean_score
        return self._env_steps, self._everything(self._games), meta

    def _everything(self, games: Any) -> dict[str, Any]:
        state = self._state
        if self._layout and self._job.count > 1:
            # On the host: whoever writes it need not wait for an update that another process may leave hanging.
            state = jax.tree.map(np.array, self._layout.nearby(state))
        return {"train": state, "collector": games}

    def _restore(self) -> None:
        """Takes over the newest good checkpoint, if there is one."""
        games = self._job.gather(self._collector.get_state())
        template = self._everything(games)
        checkpoints = self._checkpoints
        restored = self._job.by_first("checkpoints", lambda: checkpoints.restore(template) if checkpoints else None)
        found = json.loads(self._job.tell("restored", json.dumps(restored and [restored.env_steps, restored.meta])))
        if found is None:
            self._env_steps, self._games = 0, games
            return
        env_steps, meta = found
        everything = self._job.share(restored.state if restored is not None else template)
        self._state, games = self._on_all_devices(everything["train"]), everything["collector"]
        self._collector.set_state(self._job.mine(games))
        self._tracker.set_state(meta["tracker"], same_games=self._collector.resumable)
        self._env_steps, self._games = env_steps, games

    def _nearby(self, state: TrainState) -> TrainState:
        """What acting needs of the state, on this process's devices."""
        if self._layout is None:
            return state
        params, statistics = self._layout.nearby((state.params, state.statistics))
        return state._replace(params=params, statistics=statistics)

    def _on_all_devices(self, state: TrainState) -> TrainState:
        return self._layout.replicate(state) if self._layout else state

    def _newest(self) -> int:
        return max(self._checkpoints.steps(), default=0) if self._checkpoints is not None else 0

    def _is_saved(self) -> bool:
        return self._checkpoints is None or self._env_steps in (0, *self._checkpoints.steps())

    def _finish(self) -> None:
        """Saves what the last update left, before the process ends, and waits for it."""
        if self._games is None or self._checkpoints is None or not self._env_steps:
            return  # before the first rollout is through there is nothing to keep
        try:
            self._checkpoints.wait()
            self._save()
            self._checkpoints.wait()
        except RuntimeError as error:  # a failed update has taken the arrays with it
            self._warn(f"nothing newer can be saved: {str(error).partition(chr(10))[0]}")

    def _abandon(self, why: str, code: int) -> int:
        """The watchdog's last words, and the exit code: the main thread does not come back."""
        self._finish()
        if code:
            report_fault(self._config, why, None)
        elif self._is_saved():
            self._say(self._how_it_ends(why))
            return code
        else:
            why, code = self._unsaved(), 2
            self._say(f"foajax: error: {why}")
        if self._checkpoints is not None:
            note_failure(Path(self._config.run_dir), why)
        return code

    def _how_it_starts(self) -> str:
        if not self._env_steps:
            parameters = self._config.train.init_from
            begins = f", from the parameters of {parameters}" if parameters else ""
            return f"new run of {self._config.name} on {self._config.game}{begins}"
        games = "episodes go on" if self._collector.resumable else "episodes start anew, emulators cannot be saved"
        return f"resumed at {self._env_steps:,} env_steps ({games})"

    def _unsaved(self) -> str:
        reason = f"it stands at {self._env_steps:,} env_steps, of which {self._newest():,} are saved"
        return str(refuse("run", self._config.run_dir, "a directory that can be written", why=reason))

    def _how_it_ends(self, stop: str | None) -> str:
        if stop is None:
            return f"done: {self._env_steps:,} env_steps"
        if not self._env_steps:
            return f"{stop}: before anything was learned; the same command begins anew"
        return f"{stop}: saved at {self._env_steps:,} env_steps; the same command goes on from here"

    def _warn(self, text: str) -> None:
        self._say(f"warning: {text}")


def finite_mean(values: list[np.ndarray]) -> float:
    """Of what is finite: one skipped update is not to hide the others'. NaN where nothing is."""
    finite = [float(value) for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan
