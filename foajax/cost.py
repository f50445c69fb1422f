"""`python -m foajax.cost experiments=constant70_packed,nonfoa`: what a decision costs, sensor by sensor.

A decision is sense, torso, LSTM, heads and sampling, from a frame that is preprocessed and normalised
already; no game is started. FLOPs are XLA's count of the program *before* it is compiled for a device:
2 for a multiply-add of a convolution or matrix product, 1 for any other elementwise operation. So they
depend on neither the device nor what XLA fuses; but a loop counts as one turn, and thus the sensor's
repair of an area that overhangs the frame counts even where none does. Times are medians of repeats
that take turns, so that whatever else the machine does slows all experiments alike.
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
from foajax.config.compose import list_experiments
from foajax.config.parse import Section
from foajax.reporting.cost import BATCHES, PARTS, REFERENCE, measure
from foajax.runtime import wait_in_place


class Options(Section):
    """What the command takes."""

    experiments: str | None = Field(None, description="Names with commas between them; null for all.")
    torso: Literal["nature", "a3c"] = Field("nature", description="Choice of the group network/.")
    json_file: str | None = Field(None, alias="json", description="File for the result.")
    repeats: int = Field(50, ge=1, description="Repeats of each timing.")

    def check(self) -> None:
        cli.check_file("json", self.json_file)


def cost(arguments: Sequence[str]) -> None:
    """The command."""
    options = cli.parse(Options, arguments)
    wait_in_place()
    names = list_experiments() if options.experiments is None else options.experiments.split(",")
    records = measure(names, torso=options.torso, repeats=options.repeats)
    _print(records)
    if options.json_file:
        cli.write_json("json", options.json_file, records)


def _print(records: Sequence[dict[str, Any]]) -> None:
    table = Table(box=box.SIMPLE, title=f"{records[0]['torso']} torso; batches of 1 | 32")
    table.add_column("experiment", no_wrap=True)
    for heading in ("values\nnominal", "values\nshown", "torso\nkFLOP", "decision\nkFLOP", "ratio", "params"):
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


if __name__ == "__main__":
    sys.exit(cli.run(cost))
