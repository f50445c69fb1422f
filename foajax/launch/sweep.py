"""Runs a sweep on this machine: a process per run, some at a time, so that none can take another down.

Finished runs are skipped and unfinished ones go on. A run that fails is listed at the end and does not stop the others.
A signal is passed on to the running processes, which save, and no further one is started.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from foajax import cli
from foajax.config.compose import choices, compose, parse_override
from foajax.config.parse import one_line, refuse, replace
from foajax.config.schema import RENAMED, Config
from foajax.launch.signals import STOPS, handle_stops
from foajax.runs.directory import failure, forget_failure
from foajax.runs.status import is_finished

COMMAND = (sys.executable, "-m", "foajax.train")
_POLL = 0.1  # seconds between two looks at the running processes
_OUTPUT = "output.txt"  # of a run beside others, in its directory


class PlannedRun(NamedTuple):
    """One run of a sweep."""

    words: tuple[str, ...]  # its command line
    config: Config


class Stop:
    """Passes requests to stop on to the running processes and remembers that there was one."""

    def __init__(self) -> None:
        self.requested: int | None = None  # the signal
        self.processes: dict[str, subprocess.Popen] = {}  # by run directory

    def add(self, directory: str, process: subprocess.Popen) -> None:
        """Adds a process that has been started; passes on to it a signal that came meanwhile."""
        self.processes[directory] = process
        if self.requested is not None:
            process.send_signal(self.requested)

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        before = handle_stops(self._pass_on)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self.requested = number
        for process in self.processes.values():
            if process.poll() is None:
                process.send_signal(number)


def run_all(
    runs: Sequence[PlannedRun], *, jobs: int, command: Sequence[str] = COMMAND, stop: Stop | None = None
) -> int:
    """Runs `command` with each run's words, `jobs` at a time; returns 1 if one failed, else 0.

    With `jobs=1` a run has the terminal and all cores. Else it writes to `output.txt` in its directory and has its
    share of the cores. Afterwards `stop` tells whether it was asked to stop.
    """
    waiting = deque(run for run in runs if not skip_if_finished(run.config))
    failures: dict[str, str] = {}
    shares = deque(shares_of_cores(min(jobs, len(waiting) or 1)))  # so that few runs leave no core idle
    taken: dict[str, set[int]] = {}  # by run directory
    stop = stop or Stop()
    with stop.listening():
        while stop.processes or (waiting and not stop.requested):
            while waiting and len(stop.processes) < jobs and not stop.requested:
                run = waiting.popleft()
                _say(f"{run.config.run_dir}: starting")
                taken[run.config.run_dir] = cores = shares.popleft()
                try:
                    with _on(cores):
                        process = _start(run, command, alone=jobs == 1)
                    stop.add(run.config.run_dir, process)
                except OSError as error:
                    shares.append(taken.pop(run.config.run_dir))
                    failures[run.config.run_dir] = f"cannot be started ({error})"
            time.sleep(_POLL)
            for directory, process in list(stop.processes.items()):
                if (code := process.poll()) is not None:
                    del stop.processes[directory]
                    shares.append(taken.pop(directory))
                    # A run that was stopped before it could save has not failed.
                    if code and not (stop.requested and (-code in STOPS or code == cli.INTERRUPTED)):
                        ended = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit {code}"
                        failures[directory] = ended if jobs == 1 else f"{ended} (see {_OUTPUT} there)"
    return summarise([run.config for run in runs], failures)


def shares_of_cores(jobs: int) -> list[set[int]]:
    """Divides this process's cores among `jobs` runs as evenly as possible; empty sets where a system cannot.

    On shared cores a run would wait at every small product for threads that another run keeps from starting.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [set() for _ in range(jobs)]
    cores = sorted(os.sched_getaffinity(0))
    return [set(cores[job % len(cores) :: jobs]) for job in range(jobs)]


def skip_if_finished(config: Config) -> bool:
    """Returns whether a run is finished, and if so prints it."""
    if is_finished(config):
        _say(f"{config.run_dir}: finished already")
        return True
    return False


def summarise(configs: Sequence[Config], failures: Mapping[str, str]) -> int:
    """Prints which runs failed and which are not finished; returns 1 if one failed, else 0.

    `failures` has reasons by run directory, besides those that the directories hold.
    """
    lines, failed = [], 0
    for config in configs:
        directory = config.run_dir
        if directory not in failures and is_finished(config):
            continue
        reasons = [failures.get(directory), failure(Path(directory))]
        failed += any(reasons)
        lines.append(": ".join(filter(None, ["failed" if any(reasons) else "unfinished", directory, *reasons])))
    counts = f"{len(configs) - len(lines)} finished, {len(lines) - failed} unfinished, {failed} failed"
    _say(f"sweep of {len(configs)} runs: {counts}" + ("; the same command goes on from here" if lines else ""))
    for line in lines:
        _say(f"  {line}")
    return 1 if failed else 0


@contextlib.contextmanager
def _on(cores: set[int]) -> Iterator[None]:
    """Makes processes that are started meanwhile run on these cores."""
    if not cores:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _start(run: PlannedRun, command: Sequence[str], *, alone: bool) -> subprocess.Popen:
    # In a process group of its own, so that the terminal's Ctrl-C reaches it only through us.
    forget_failure(Path(run.config.run_dir))
    words = [*command, *run.words]
    if alone:
        return subprocess.Popen(words, process_group=0)
    path = Path(run.config.run_dir)
    path.mkdir(parents=True, exist_ok=True)
    with (path / _OUTPUT).open("ab") as output:
        return subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, process_group=0
        )


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def expand(words: Sequence[str], config_dir: Path | None = None) -> list[PlannedRun]:
    """Composes and checks every run of a sweep, so that a mistake in the last one does not show hours later."""
    swept = swept_by(words)
    runs: dict[str, PlannedRun] = {}
    for overrides in itertools.product(*(_values(word, config_dir) for word in words)):
        plain = compose(overrides, config_dir)
        config = named(plain, overrides, swept)
        if config.run_dir in runs:
            accepted = "a directory for each, as with 'name=constant70-${gaze.mode}'"
            raise refuse("run", config.run_dir, accepted, why="two runs would share it")
        name = [] if config == plain else [f"name='{config.name}'"]
        runs[config.run_dir] = PlannedRun((*overrides, *name), config)
    return list(runs.values())


def swept_by(words: Sequence[str]) -> dict[str, str]:
    """Finds the keys that a sweep varies. Each is listed as it was typed and, if it was renamed, by its new name."""
    typed = [override.key_or_group for override in map(parse_override, words) if override.is_sweep_override()]
    return {**{key: key for key in typed}, **{RENAMED[key]: key for key in typed if key in RENAMED}}


def named(config: Config, overrides: Iterable[str], swept: Mapping[str, str]) -> Config:
    """Adds what the sweep chose to the run's name, except for what names the directory anyway."""
    known = {"experiment", "game", "seed", "name", "run"}
    parsed = {override.key_or_group: override for override in map(parse_override, overrides)}
    if {"name", "run"} & parsed.keys():
        return config
    chosen = [f"{swept[key]}={parsed[key].get_value_string()}" for key in parsed if key in swept.keys() - known]
    return replace(config, name="-".join([config.name, *(re.sub(r"[^\w.=+-]+", "-", c) for c in chosen)]))


def _values(word: str, config_dir: Path | None) -> Iterable[str]:
    """Splits an override of a sweep into the single ones that it stands for."""
    from hydra.core.override_parser.types import Glob

    override = parse_override(word)
    key, value = override.key_or_group, override.value()
    if not override.is_sweep_override():
        return [word]
    if isinstance(value, Glob):
        names = choices(config_dir).get(key, ())
        if not (chosen := value.filter(list(names))):
            raise refuse(one_line(word), accepted=f"what matches one of {', '.join(names) or 'no names'}")
        return [f"{key}={choice}" for choice in chosen]
    if not override.is_discrete_sweep():
        raise refuse(one_line(word), accepted="a list of values")
    return [f"{key}={choice}" for choice in override.sweep_string_iterator()]
