"""How long does visual search take by looking, and how long by reading the whole frame once?

    python benchmarks/search_cost.py [decisions=8] [out=results.json]

Prints for frames of 160x160 and 1080x1920 the median time of one decision, and of an answer after `decisions` of them.
The frame is in the device's memory, and the four programs take turns. Run it on an idle machine.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from pydantic import Field

from foajax import cli, runtime
from foajax.config.compose import compose
from foajax.config.parse import replace
from foajax.reporting import bench, cost, search


class Options(bench.Options):
    decisions: float = Field(8, gt=0, description="Decisions until the answer.")
    repeats: int = Field(200, ge=1, description="Repeats of each timing.")


def main(arguments: Sequence[str]) -> None:
    options = cli.parse(Options, arguments)
    runtime.wait_in_place()
    config = compose(["experiment=search_rings_p"])
    sizes = [replace(config, env=replace(config.env, frame_shape=shape)) for shape in search.SHAPES]
    found = cost.measure_decisions([each for at in sizes for each in (at, search.whole(at))], repeats=options.repeats)
    results = []
    for shape, looked, whole in zip(search.SHAPES, found[::2], found[1::2], strict=True):
        looked_us, whole_us = looked["decision_us_batch1"], whole["decision_us_batch1"]
        answer = options.decisions * looked_us
        results.append({"frame": shape, "decision_us": looked_us, "answer_us": answer, "whole_frame_us": whole_us})
        print(
            f"{shape[0]}x{shape[1]}: a decision {looked_us:.0f} us, an answer {answer:.0f} us, the whole frame once "
            f"{whole_us:.0f} us, {whole_us / answer:.1f} times as long as the answer"
        )
    if options.out:
        bench.write("out", options.out, results, ["python", "benchmarks/search_cost.py", *arguments])


if __name__ == "__main__":
    sys.exit(cli.run(main))
