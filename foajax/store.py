"""Makes an agent to ship from a run: `foajax store run=<dir> out=<dir>`.

The agent is one safetensors file of parameters and frame statistics, with its configuration. Other programs can read
it without this package.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from foajax import cli
from foajax.config.parse import refuse
from foajax.runs.agents import FACTS, StoredAgent, TrainedAgent, load_score, save_agent
from foajax.runs.directory import PARAMETERS


def _read_score(file: Path, stored: TrainedAgent) -> dict[str, Any]:
    config = stored.agent.config
    expected = {"game": config.game, "experiment": config.name, "env_steps": stored.env_steps}
    try:
        result = json.loads(file.read_text())
        found = {key: result[key] for key in expected}
        score = {key: result[key] for key in ("mean", "stderr", "episodes", "policy")}
    except (OSError, ValueError, KeyError, TypeError):
        raise refuse("score", file, "a file that foajax evaluate json=<file> has written") from None
    if found != expected:
        raise refuse("score", file, f"that of this agent, {expected}", why=f"is of {found}")
    return score


class Options(StoredAgent):
    out: str = Field(description="Directory of the agent.")
    score: str | None = Field(None, description="File that `evaluate json=` has written, to go with the agent.")


def store(arguments: Sequence[str]) -> None:
    """Writes the agent and prints where."""
    options = cli.parse(Options, arguments)
    stored = options.load()
    score = load_score(options.run) if options.score is None else _read_score(Path(options.score), stored)
    save_agent(stored, Path(options.out), score)
    print(f"{options.out}: {PARAMETERS}, config.yaml, {FACTS}")


if __name__ == "__main__":
    sys.exit(cli.run(store))
