"""Writes a folder that runs an agent without JAX and foajax: `foajax export run=<run or agent> out=robot/`.

The folder holds the network (`policy.onnx`), `agent.py`, which decides with it, and `camera.py` and `node.py`, which
look through a camera. `python agent.py --check` replays 200 recorded decisions. If that check fails, nothing
is written. The command needs the extra `robot`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from foajax import cli
from foajax.config.parse import refuse
from foajax.runs.agents import StoredAgent


class Options(StoredAgent):
    out: str = Field(description="Directory of the folder to write.")
    dtype: Literal["float32", "float16", "int8"] = Field(
        "float32", description="Type of the weights; float16 halves the file, int8 thirds it and is less exact."
    )
    stablehlo: bool = Field(False, description="Write the whole decision as a program for JAX too.")


def export(arguments: Sequence[str]) -> None:
    """Writes the folder, checks it, and prints what it wrote."""
    options = cli.parse(Options, arguments)
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise refuse("export", accepted="", why=f"{error.name} is missing (pip install 'foajax[robot]')") from None
    from foajax.robot import folder

    stored = options.load()
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
