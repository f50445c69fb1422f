"""Measures what a decision costs, sensor by sensor: `foajax cost experiments=constant70_packed,nonfoa`.

A decision is sensor, torso, core, heads and sampling, from a preprocessed, normalised frame; no game is started. FLOPs
are XLA's count of the program before it compiles it for a device: 2 per multiply-add of a convolution or matrix
product, 1 per other elementwise operation. So they do not depend on the device. A loop counts as one turn, and the
sensor's repair of an area that overhangs the frame always counts. Times are medians of repeats; experiments take turns,
so that other load on the machine slows all of them alike.

`target=onnx` times the folders that `foajax export` writes, on one thread (extra `robot`): from a screen, and from a
camera's image, to the next focal point. Only experiments with frames of 80x80 can be timed so.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from typing import Any, Literal

import jax
from pydantic import Field
from rich import box
from rich.console import Console
from rich.table import Table

from foajax import cli
from foajax.config.compose import compose, list_experiments
from foajax.config.parse import Section, refuse
from foajax.reporting import bench
from foajax.reporting.cost import BATCHES, PARTS, REFERENCE, measure
from foajax.runtime import wait_in_place


class Options(Section):
    experiments: str | None = Field(None, description="Experiments, with commas between them; null for all.")
    torso: Literal["nature", "a3c"] | None = Field(
        None, description="A choice of network= for all; null for each experiment's own."
    )
    json_file: str | None = Field(None, alias="json", description="JSON file to write the result to.")
    color: bool = Field(False, alias="env.color", description="Frames in colour; else gray.")
    repeats: int = Field(50, ge=1, description="Repeats of each timing.")
    target: Literal["jax", "onnx"] = Field("jax", description="What runs: JAX, or the folders that export writes.")
    dtype: Literal["float32", "float16", "int8"] = Field(
        "float32", description="Type of the weights where target=onnx."
    )

    def check(self) -> None:
        cli.check_file("json", self.json_file)
        for name in self.names:
            if name not in (known := list_experiments()):
                raise refuse("experiments", name, known)

    @property
    def names(self) -> list[str]:
        if self.experiments is not None:
            return self.experiments.split(",")
        return [name for name in list_experiments() if self.target == "jax" or has_atari_frames(name)]


def has_atari_frames(experiment: str) -> bool:
    """Whether an experiment looks at frames of Atari's size, which `target=onnx` can time."""
    return compose([f"experiment={experiment}"]).env.frame_shape == (80, 80)


def cost(arguments: Sequence[str]) -> None:
    """Measures each experiment and prints a table of what a decision costs."""
    options = cli.parse(Options, arguments)
    wait_in_place()
    if options.target == "onnx":
        records = _exported(options.names, options)
        _print_exported(records)
    else:
        records = measure(options.names, torso=options.torso, color=options.color, repeats=options.repeats)
        _print(records)
    if options.json_file:
        bench.write("json", options.json_file, records, ["python", "-m", "foajax.cost", *arguments])


def _exported(names: Sequence[str], options: Options) -> list[dict[str, Any]]:
    try:
        from foajax.robot import latency
    except ImportError as error:
        raise refuse("target", "onnx", "", why=f"{error.name} is missing (pip install 'foajax[robot]')") from None
    return latency.measure(
        names, torso=options.torso, color=options.color, dtype=options.dtype, repeats=options.repeats
    )


def _print(records: Sequence[dict[str, Any]]) -> None:
    table = Table(box=box.SIMPLE, title="Batches of 1 | 32")
    table.add_column("experiment", no_wrap=True)
    for heading in ("torso", "values\nnominal", "values\nshown", "torso\nkFLOP", "decision\nkFLOP", "ratio", "params"):
        table.add_column(heading)
    for heading in ("sense us", "network us", "decision us", "ratio"):
        table.add_column(f"{heading}\n1 | 32", no_wrap=True)
    for column in table.columns[1:]:
        column.justify = "right"
    for record in records:
        pairs = [" | ".join(f"{record[f'{part}_us_batch{batch}']:,.0f}" for batch in BATCHES) for part in PARTS]
        ratios = " | ".join(f"{record[f'decision_us_batch{batch}_ratio']:.2f}" for batch in BATCHES)
        table.add_row(
            record["experiment"],
            record["torso"],
            f"{record['pixels_nominal']:,}",
            f"{record['pixels_actual']:,}",
            f"{record['torso_flops'] / 1e3:,.0f}",
            f"{record['decision_flops'] / 1e3:,.0f}",
            f"{record['decision_flops_ratio']:.3f}",
            f"{record['params']:,}",
            *pairs,
            ratios,
        )
    console = Console(width=150, highlight=False)
    console.print(table)
    device = f"{jax.devices()[0].device_kind}, host {platform.machine()} with {os.cpu_count()} cores"
    console.print(f"Ratios are to {REFERENCE}. {device}, jax {jax.__version__}.")


def _print_exported(records: Sequence[dict[str, Any]]) -> None:
    table = Table(box=box.SIMPLE, title=f"ONNX Runtime, {records[0]['dtype']}; us, median | 99%")
    headings = ("frame", "sense", "torso", "network", "screen", "camera", "JAX, screen")
    for heading in ("experiment", *headings, "ratio", "file\nMB", "memory\nMB", "start\ns", "energy est.\nuJ"):
        table.add_column(heading, no_wrap=True, justify="left" if heading == "experiment" else "right")
    for record in records:
        parts = ("frame", "sense", "torso", "network", "screen", "camera", "jax_screen")
        table.add_row(
            record["experiment"],
            *(f"{record[f'{part}_us']:,.0f} | {record[f'{part}_us_p99']:,.0f}" for part in parts),
            f"{record['screen_ratio']:.2f}",
            f"{record['bytes'] / 1e6:.1f}",
            f"{record['memory_mb']:.0f}",
            f"{record['start_s']:.2f}",
            f"{record['screen_energy_estimate_uj']:.0f}",
        )
    console = Console(width=170, highlight=False)
    console.print(table)
    console.print(
        "screen is a whole decision: frame, sense and network; torso is a part of network. camera is a decision from a "
        "colour image of 1080x1920. Energy is estimated from operations and bytes read."
    )


if __name__ == "__main__":
    sys.exit(cli.run(cost))
