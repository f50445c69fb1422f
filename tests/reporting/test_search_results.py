"""What docs/search.md says of runs: intervals, returns, what was not run; and that the page is of the kept runs."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.reporting import claims, kept, results, search
from foajax.reporting.curves import RunData
from foajax.reporting.markdown import fill

CONFIG = compose(["experiment=search_rings_p"])
SIZES = CONFIG.search.set_sizes


def run_of(tmp_path, name, accuracy, *, seed=0, experiment="search_rings_p"):
    """A run in which each further letter costs half a fixation, a whole one where there is no target."""
    measures = {"accuracy": accuracy, "decisions": 5.0, "slope_present": 0.5, "slope_absent": 1.0}
    for size in SIZES:
        measures |= {f"accuracy_{size}": accuracy, f"decisions_{size}": 2.0 + size / 2}
        measures |= {f"fixations_present_{size}": 2.0 + size / 2, f"fixations_absent_{size}": 2.0 + size}
    measures |= {"hit_rate": 0.99, "distance": 3.0, "overlap": 0.49}
    absent = f"search.absent={name.endswith('letter')}"
    config = compose([f"experiment={experiment}", f"name={name}", f"seed={seed}", absent])
    return RunData(tmp_path, config, *[np.arange(2.0)] * 3, {"mean": 0.5, "measures": measures})


def test_an_interval_over_seeds_is_students():
    found = search.over_seeds([0.8, 0.9, 1.0])
    half = 4.303 * 0.1 / np.sqrt(3)  # of two degrees of freedom
    assert found == pytest.approx((0.9, 0.9 - half, 0.9 + half), abs=1e-3)
    assert search.over_seeds([0.5]) == (0.5, 0.5, 0.5)


def test_a_return_is_of_answers_and_decisions(tmp_path):
    assert search.earned([run_of(tmp_path, "any", 0.9)], 8).value == pytest.approx(0.9 - 0.1 - 0.01 * 6)


def test_the_page_has_what_was_run_and_says_what_was_not(tmp_path):
    (tmp_path / "results").mkdir()
    page = tmp_path / "search.md"
    page.write_text("before\n<!-- results: made by x -->\nold\n<!-- /results -->\nafter\n")
    search.write([], tmp_path)
    assert "old" in page.read_text()
    names = ("search_rings_p", "search_rings_p-letter")
    runs = [run_of(tmp_path, name, 0.9 + 0.01 * s, seed=s) for name in names for s in range(3)]
    search.write([*runs, run_of(tmp_path, "detect_rings_p", 0.95, experiment="detect_rings_p")], tmp_path)
    text = page.read_text()
    assert text.startswith("before\n<!-- results") and text.endswith("<!-- /results -->\nafter\n") and "old" not in text
    assert "| rings and periphery | 556 | 1.5 M | 3 | 0.795 [0.745, 0.845] |" in text
    assert "| letter: a T among Ls, in every scene | 1.5 M | 3 | 0.5 |  | 0.91 [" in text
    assert "| the same, in half of the scenes | 1.5 M | 3 | 0.5 | 1 | 0.91 [" in text
    assert (
        "Detection (seeds: 1): the return is 0.5, with 5 decisions. The share of right answers is 0.99, that of" in text
    )
    tables = (search._SENSORS, search._GAZES, search._TARGETS)
    assert text.count(claims.NOT_RUN) == sum(map(len, tables)) - 4
    rows = [line for line in text.splitlines() if line.startswith(("| 160x160", "| 1080x1920"))]
    ratios = [float(row.split("|")[-2].replace(",", "")) for row in rows]
    assert len(ratios) == 2 and 1 < ratios[0] < ratios[1] and ratios[1] > 50
    with Image.open(tmp_path / "results" / "search.png") as figure:
        assert figure.width > 1000


def test_a_seed_counts_once_and_all_are_of_one_length(tmp_path):
    runs = [run_of(tmp_path / str(i), "search_rings_p", 0.9, seed=seed) for i, seed in enumerate((0, 1, 0))]
    with pytest.raises(ConfigError, match=r"/2: repeats it; accepted is another seed than that of .*/0$"):
        search.grouped(runs)
    longer = compose(["experiment=search_rings_p", "seed=2", "train.env_steps=6000000"])
    with pytest.raises(ConfigError, match="is of 6,000,000 env_steps"):
        search.grouped([*runs[:2], runs[2]._replace(config=longer)])


def test_a_seed_that_never_says_absent_is_left_out_of_its_fixations(tmp_path):
    runs = [run_of(tmp_path, "search_rings_p-letter", 0.9, seed=seed) for seed in range(2)]
    del runs[0].evaluation["measures"]["slope_absent"]
    assert search.measure(runs, "slope_absent") == (1.0, 1.0, 1.0)
    assert np.isnan(search.measure(runs[:1], "slope_absent").value)


def test_the_page_in_the_repository_is_what_its_runs_say():
    groups = search.grouped(kept.runs(results.ROOT / "results/runs"))
    page = (results.ROOT / "docs/search.md").read_text()
    assert page == fill(page, search.block(groups))
