"""`python -m foajax.export run=<run or agent> out=robot/`: a folder that runs the agent without JAX and this package.

The folder holds the network (`policy.onnx`), `agent.py` that decides with it, `camera.py` and `node.py` that look
through a camera, and 200 recorded decisions that `python agent.py --check` replays. Nothing is written where that check
fails. It needs the extra `robot`.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from foajax import cli
from foajax.config import ConfigError
from foajax.store import load_agent


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    run: str  # a run directory or a shipped agent
    out: str  # the folder
    checkpoint: Literal["newest", "best"] = "newest"  # of a run: the latest, or that with the best score in training
    dtype: Literal["float32", "float16", "int8"] = "float32"  # of the weights; float16 halves the file, int8 is faster
    stablehlo: bool = False  # write the whole decision as a program for JAX too


def export(arguments: Sequence[str]) -> None:
    """The command."""
    options = cli.parse(Options, arguments)
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"export: {error.name} is missing; accepted is an installation of foajax[robot]") from None
    from foajax.robot import folder

    stored = load_agent(options.run, best=options.checkpoint == "best")
    words = ["python", "-m", "foajax.export", *arguments]
    found = folder.write(
        stored,
        Path(options.out),
        source=options.run,
        dtype=options.dtype,
        with_stablehlo=options.stablehlo,
        command=words,
    )
    size = sum(file.stat().st_size for file in Path(options.out).iterdir())
    print(f"{options.out}: {size / 1e6:.1f} MB; {found}")


if __name__ == "__main__":
    sys.exit(cli.run(export))
