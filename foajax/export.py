"""`python -m foajax.export run=<run or agent> out=robot/`: a folder that runs the agent without JAX and this package.

The folder holds the network (`policy.onnx`), `agent.py` that decides with it, `camera.py` and `node.py` that look
through a camera, and 200 recorded decisions that `python agent.py --check` replays. Nothing is written where that check
fails. It needs the extra `robot`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from foajax import cli
from foajax.config.parse import Section, refuse
from foajax.runs.agents import load_agent


class Options(Section):
    """What the command takes."""

    run: str = Field(description="Directory of a run or an agent, or a shipped agent's name.")
    out: str = Field(description="The folder.")
    checkpoint: Literal["newest", "best"] = Field(
        "newest", description="Of a run: the latest, or that with the best score in training."
    )
    dtype: Literal["float32", "float16", "int8"] = Field(
        "float32", description="Of the weights; float16 halves the file, int8 thirds it and is less exact."
    )
    stablehlo: bool = Field(False, description="Whether the whole decision is written as a program for JAX too.")
    trust: bool = Field(False, description="Whether code that the run's configuration names may run.")


def export(arguments: Sequence[str]) -> None:
    """The command."""
    options = cli.parse(Options, arguments)
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise refuse("export", accepted="foajax[robot]", why=f"{error.name} is missing") from None
    from foajax.robot import folder

    stored = load_agent(options.run, best=options.checkpoint == "best", trust=options.trust)
    found = folder.write(
        stored,
        Path(options.out),
        source=options.run,
        dtype=options.dtype,
        with_stablehlo=options.stablehlo,
        command=["foajax", "export", *arguments],
    )
    size = sum(file.stat().st_size for file in Path(options.out).iterdir())
    print(f"{options.out}: {size / 1e6:.1f} MB; {found}")


if __name__ == "__main__":
    sys.exit(cli.run(export))
