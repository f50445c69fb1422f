"""`python -m foajax.store run=<dir> out=<dir>`: makes of a run an agent to be shipped.

It has parameters and frame statistics only, as one safetensors file, and can be read without this package.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from foajax import cli
from foajax.config.parse import ConfigError
from foajax.runs.agents import FACTS, TrainedAgent, load_agent, load_score, save_agent
from foajax.runs.directory import PARAMETERS


def _read_score(file: Path, stored: TrainedAgent) -> dict[str, Any]:
    config = stored.agent.config
    expected = {"game": config.game, "experiment": config.name, "env_steps": stored.env_steps}
    try:
        result = json.loads(file.read_text())
        found = {key: result[key] for key in expected}
        score = {key: result[key] for key in ("mean", "stderr", "episodes", "policy")}
    except (OSError, ValueError, KeyError, TypeError):
        raise ConfigError(f"score={file}: accepted is a file that evaluate json=<file> has written") from None
    if found != expected:
        raise ConfigError(f"score={file}: is of {found}; accepted is that of this agent, {expected}")
    return score


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    run: str
    out: str
    checkpoint: Literal["newest", "best"] = "newest"  # of a run: the latest, or that with the best score in training
    score: str | None = None  # file that `evaluate json=` has written, to go with the agent
    trust: bool = False  # whether code that the run's configuration names may run


def export(arguments: Sequence[str]) -> None:
    """The command."""
    options = cli.parse(Options, arguments)
    stored = load_agent(options.run, best=options.checkpoint == "best", trust=options.trust)
    score = load_score(options.run) if options.score is None else _read_score(Path(options.score), stored)
    save_agent(stored, Path(options.out), score)
    print(f"{options.out}: {PARAMETERS}, config.yaml, {FACTS}")


if __name__ == "__main__":
    sys.exit(cli.run(export))
