"""A logger beside ``metrics.jsonl`` and TensorBoard: Weights & Biases, or a user's class (`train.logger`)."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from foajax.config.parse import refuse, to_mapping
from foajax.config.parts import bind_part
from foajax.config.schema import Config


@runtime_checkable
class RowLogger(Protocol):
    """Receives each row that goes to `metrics.jsonl`.

    Each start of a run makes one, with the arguments `config` and `train.logger_kwargs`; of several processes only the
    first does. Training waits for it. If it raises, training prints a warning and goes on.
    """

    def log(self, row: Mapping[str, float], env_steps: int) -> None:
        """Receives a row: metrics by name, without those that are not finite.

        A resumed run repeats the rows after its checkpoint.
        """

    def close(self) -> None:
        """Is called when the run ends or stops, but not if the process is killed or an environment hangs."""


class WandB:
    """Weights & Biases. `kwargs` are those of `wandb.init`: `project`, `mode="offline"`, ..."""

    def __init__(self, config: Config, **kwargs: Any) -> None:
        import wandb

        run_dir = Path(config.run_dir)
        about = {"project": "foajax", "name": run_dir.name, "dir": run_dir, "config": to_mapping(config)}
        self._run = wandb.init(**(about | kwargs))
        self._run.define_metric("*", step_metric="env_steps")  # its own steps may not go back, a resumed run's do

    def log(self, row: Mapping[str, float], env_steps: int) -> None:
        self._run.log({**row, "env_steps": env_steps})

    def close(self) -> None:
        """Waits until all rows are sent, or written where offline."""
        self._run.finish()


def find_logger(config: Config) -> Callable[[], RowLogger] | None:
    """Returns what makes the logger that `train.logger` names, or None. It imports code that the user trusts.

    Raises:
      ConfigError: it cannot be found, or it takes other arguments than `train.logger_kwargs`.
    """
    name, kwargs = config.train.logger, to_mapping(config.train.logger_kwargs)
    if name is None:
        return None
    if name == "wandb":
        _check_wandb(kwargs)
    make = bind_part("train.logger", name, {"wandb": WandB}, **kwargs | {"config": config})
    if isinstance(make.func, type) and not issubclass(make.func, RowLogger):
        raise refuse("train.logger", name, "a class with log(row, env_steps) and close()")
    return make


def _check_wandb(kwargs: Mapping[str, Any]) -> None:
    try:
        import wandb
    except ImportError as error:
        raise refuse("train.logger", "wandb", "", why=f"{error.name} is missing (pip install wandb)") from None
    known = inspect.signature(wandb.init).parameters
    for key in kwargs:
        if key not in known:
            raise refuse(f"train.logger_kwargs.{key}", kwargs[key], known, why="unknown to wandb.init", near=key)
