"""The page of results: each claim's verdict both ways, intervals, and that the page is what the kept runs say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from foajax.config.compose import compose
from foajax.config.parse import ConfigError, to_mapping
from foajax.reporting import claims, curves, kept, results
from foajax.reporting.claims import CLAIMS, Game, ask
from foajax.reporting.curves import RunData
from foajax.reporting.markdown import fill
from foajax.reporting.scores import Interval
from foajax.sensors import gaze
from foajax.viewing.heatmap import HeatMap

CONFIG = compose(["experiment=constant70_p_packed"])
STEPS = np.linspace(10_000, 3_000_000, 60)
COSTS = [
    {
        **{"experiment": "constant70_p_packed", "torso": "nature", "decision_flops": 7_494_968},
        **{"decision_us_batch1": 346.0, "decision_us_batch32": 4953.0},
    }
]


def run_of(mean, *, seed=0, pace=1.0):
    """A run whose games score `mean` on average, and whose curve ends there after having risen at its pace."""
    returns = mean + np.random.default_rng(seed).normal(0, 0.02 * abs(mean), 100)
    score = mean * np.minimum(1, pace * STEPS / STEPS[-1])
    return RunData(Path(), CONFIG, STEPS, STEPS / 700, score, {"mean": returns.mean(), "returns": list(returns)})


def seeds_of(mean, pace=1.0, number=3):
    return [run_of(mean * (1 + 0.02 * seed), seed=seed, pace=pace) for seed in range(number)]


def heat_of(*points):
    return HeatMap(
        gaze.count(np.array(points), (80, 80)), np.zeros((80, 80)), np.array([35, 35]), np.array([45, 45]), 1
    )


LOW, HIGH = [(44, 40)] * 9 + [(45, 41)], [(36, 40)] * 9 + [(45, 40)]
STILL, RESTLESS = LOW, [(y, x) for y in (35, 45) for x in (35, 45)]
CONTROLS = [f"constant70_p{what}" for what in ("-frozen", "-frozen-low", "-random", "-scripted", "-priced", ", canvas")]
NAMES = [*curves.PAPER_NAMES, *CONTROLS, "decreasing, canvas", "logpolar"]
# Of each claim: who scores how much, at which pace, where it holds and where it does not; 100 at pace 1 for the others.
BOTH_WAYS = {
    "Lower resolution at 50x50 hurts": ({"constant50_sub2": (50, 1)}, {"constant50_sub2": (150, 1)}),
    "70x70 at half resolution beats 50x50 at full, with half the pixels": (
        {"constant70": (150, 1)},
        {"constant70": (50, 1)},
    ),
    "Decreasing resolution is about equal to constant": ({}, {"decreasing": (50, 1)}),
    "The outer ring helps": ({"decreasing": (150, 1)}, {"decreasing": (50, 1)}),
    "The periphery improves the score": (
        {"constant70_p": (150, 1), "decreasing_p": (150, 1)},
        {"constant70_p": (150, 1), "decreasing_p": (50, 1)},
    ),
    "The periphery makes learning faster": (
        {"constant70_p": (100, 4), "decreasing_p": (100, 4)},
        {"constant70_p": (100, 4), "decreasing": (100, 4)},
    ),
    "A fifth of the pixels is enough": ({}, {"constant70_p": (70, 1)}),
    "Learning takes about 5 times longer": ({"nonfoa": (100, 5)}, {"nonfoa": (100, 1)}),
    "A gaze slows the first learning": ({"nonfoa": (100, 4)}, {"constant70": (100, 4)}),
    "Without gaze control it is much worse": (
        {"constant70_p-frozen": (30, 1)},
        {"constant70_p-frozen": (70, 1)},  # worse, but not much worse
    ),
    "A learned gaze beats one frozen low": (
        {"constant70_p-frozen-low": (50, 1)},
        {"constant70_p-frozen-low": (150, 1)},
    ),
    "A learned gaze beats a random one": ({"constant70_p-random": (50, 1)}, {"constant70_p-random": (150, 1)}),
    "A learned gaze beats a scripted one": ({"constant70_p-scripted": (50, 1)}, {"constant70_p-scripted": (150, 1)}),
    "A price for moving improves a learned gaze": ({"constant70_p-priced": (150, 1)}, {"constant70_p-priced": (50, 1)}),
    "Packed values score no less than the paper's canvas": ({}, {"constant70_p, canvas": (150, 1)}),
    "Packed rings score no less than the paper's canvas": ({}, {"decreasing, canvas": (150, 1)}),
    "A log-polar retina scores no less than squares of as many values": ({}, {"logpolar": (50, 1)}),
}
GAZES = {"The gaze stays in the lower half": (LOW, HIGH), "The gaze moves little": (STILL, RESTLESS)}


def asked(title, changed, *, number=3, points=STILL):
    runs = {name: seeds_of(*changed.get(name, (100, 1)), number) for name in NAMES}
    heats = {name: [heat_of(*points)] * number for name in NAMES}
    return ask(next(claim for claim in CLAIMS if claim.title == title), Game("breakout", runs, heats))


@pytest.mark.parametrize("title", BOTH_WAYS)
def test_a_claim_holds_and_does_not_hold(title):
    yes, no = BOTH_WAYS[title]
    assert asked(title, yes).verdict == "holds"
    assert asked(title, no).verdict == "does not hold"
    assert asked(title, yes, number=1).verdict == "one seed suggests yes"
    assert asked(title, no, number=2).verdict == "2 seeds suggest no"


@pytest.mark.parametrize("title", GAZES)
def test_a_claim_about_the_gaze_holds_and_does_not_hold(title):
    yes, no = GAZES[title]
    assert asked(title, {}, points=yes).verdict == "holds"
    assert asked(title, {}, points=no).verdict == "does not hold"
    assert asked(title, {}, points=no, number=1).verdict == "one seed suggests no"


def test_each_claim_is_tested():
    assert {claim.title for claim in CLAIMS} == BOTH_WAYS.keys() | GAZES.keys()


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.title)
def test_nothing_is_said_of_what_was_not_run(claim):
    assert ask(claim, Game("breakout", {})) == ("not run yet", [])
    alone = {"constant70_p": seeds_of(100), "decreasing": seeds_of(100)}
    assert ask(claim, Game("breakout", alone)).verdict == "not run yet"


def test_seeds_that_overlap_cannot_tell():
    runs = {"constant50_sub1": [run_of(mean) for mean in (50, 90, 130)], "constant50_sub2": seeds_of(60)}
    assert ask(CLAIMS[0], Game("breakout", runs)).verdict == "cannot tell"
    one = {"constant50_sub1": [run_of(100)], "constant50_sub2": [run_of(100.1, seed=1)]}
    finding = ask(CLAIMS[0], Game("breakout", one))
    assert finding.verdict == "one seed cannot tell"
    assert finding.seen[0].startswith("Score: `constant50_sub1` 100 [99.8, 101], ")


PONG = {"nonfoa": 19, "decreasing": -10}  # -20.7 is random play


@pytest.mark.parametrize(
    ("others", "verdict"),
    [
        ({"constant50_sub1": -20.9}, "holds"),  # it has an infinite ratio to one that is no better than random play
        ({"constant50_sub1": -20.7}, "holds"),
        ({"constant50_sub1": 5}, "does not hold"),
        ({"constant50_sub1": -20.5, "decreasing": -20.2}, "cannot tell"),  # neither has learned
        ({"constant50_sub1": -21, "decreasing": -21}, "cannot tell"),
    ],
)
def test_who_has_not_learned_a_game_cannot_tell(others, verdict):
    game = Game("pong", {name: [run_of(mean, seed=i) for i in range(3)] for name, mean in (PONG | others).items()})
    finding = ask(next(claim for claim in CLAIMS if claim.title == "The outer ring helps"), game)
    assert finding.verdict == verdict
    assert finding.seen[0].endswith("; neither has learned") == (verdict == "cannot tell")


def test_first_learning_is_asked_of_agents_that_learn_the_game_later():
    game = Game("breakout", {"nonfoa": seeds_of(400, pace=0.4), "constant70": seeds_of(260, pace=0.3)})
    claim = next(claim for claim in CLAIMS if claim.title == "A gaze slows the first learning")
    assert ask(claim, game).verdict == "holds"


def test_how_much_longer_is_not_asked_of_who_has_not_learned():
    game = Game("pong", {"nonfoa": seeds_of(19), "constant70_p": seeds_of(-20.6)})
    finding = ask(next(claim for claim in CLAIMS if claim.title == "Learning takes about 5 times longer"), game)
    assert finding == ("cannot tell", ["`constant70_p` has not learned"])


def test_an_interval_is_that_of_an_independent_bootstrap():
    run = run_of(100)
    returns, drawn = np.array(run.evaluation["returns"]), np.random.default_rng(7)
    means = [np.mean([returns[drawn.integers(100)] for _ in range(100)]) for _ in range(2000)]
    found = claims.score([run])
    np.testing.assert_allclose(found, [returns.mean(), *np.percentile(means, [2.5, 97.5])], rtol=0.002)
    three = [run_of(mean) for mean in (10, 20, 60)]  # of 27 samples one is 3 times the least: more than 2.5 %
    finals = [each.final_score for each in three]
    assert claims.score(three) == (pytest.approx(np.mean(finals)), min(finals), max(finals))


def test_a_ratio_goes_from_the_smallest_to_the_largest():
    assert claims.over(Interval(6, 4, 8), Interval(3, 2, 4)) == (2, 1, 4)
    assert claims.over(Interval(1, -1, 2), Interval(0, -1, 1)) == (np.inf, 0, np.inf)  # no better than random play
    assert claims.over(Interval(3, 2, 4), Interval(0, -1, 1)) == (np.inf, 2, np.inf)
    assert claims.over(Interval(3, 2, 4), Interval(-2, -3, -1)) == (np.inf, np.inf, np.inf)


def test_times_longer_is_read_where_both_have_the_lower_score():
    slow, fast = run_of(50), run_of(100, pace=2)  # 50 at the end; at a quarter
    found = claims.times_longer([slow], [fast], "env_steps")
    assert found.value == found.low == found.high == pytest.approx(4, rel=0.02)


def test_labels_are_spread():
    assert curves.spread([0.0, 10.0, 20.0], 1.0) == [0, 10, 20]
    assert curves.spread([5.0, 5.2, 5.1, 50.0], 1.0) == pytest.approx([4.1, 6.1, 5.1, 50])


def test_a_sensor_has_one_colour_whatever_else_is_shown():
    names = ["mine", "nonfoa", "constant70_p_packed-frozen", "Constant(P) 70x70, sub2, packed", "constant70_p, canvas"]
    mine, gray, *blue = curves.colours_of(names).values()
    assert set(blue) == {curves.SENSORS["constant70_p"]} and gray == curves.SENSORS["nonfoa"]
    assert mine not in (gray, *blue)


# The page


def keep_run(directory, words, mean, *, seed=0, steps=3_000_000):
    """A kept run, as `foajax keep` leaves it."""
    config = compose([*words, f"seed={seed}", f"train.env_steps={steps}"])
    path = directory / config.game / f"{config.name}-s{seed}"
    (path / "render").mkdir(parents=True)
    (path / "config.yaml").write_text(yaml.safe_dump(to_mapping(config)))
    run = run_of(mean, seed=seed)
    rows = zip(run.env_steps, run.time, run.score, strict=True)
    lines = [json.dumps(dict(zip(("env_steps", "time", "score"), map(float, row), strict=True))) for row in rows]
    (path / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    (path / "score.json").write_text(json.dumps(run.evaluation))
    facts = {"env_steps": steps, "cores": 2, "python": "3.12.1", "cpu": "a processor", "packages": {"jax": "0.11.2"}}
    (path / "run.json").write_text(json.dumps(facts))
    heat = heat_of(*LOW).to_json() | {"env_steps": steps, "policy": "sampled", "whole_games": True}
    (path / "render" / "heatmap.json").write_text(json.dumps(heat))
    return path


@pytest.fixture
def checkout(tmp_path):
    """Breakout with three sensors of one seed, the gaze frozen as well; in the layout of a checkout."""
    runs = tmp_path / "results" / "runs"
    for name, mean in (("nonfoa", 120), ("constant70_p_packed", 100), ("constant70_packed", 90)):
        keep_run(runs, ["game=breakout", f"experiment={name}"], mean)
    frozen = ["experiment=constant70_p_packed", "gaze=frozen", "name=constant70_p_packed-frozen"]
    keep_run(runs, ["game=breakout", *frozen], 40)
    (tmp_path / "results" / "bench").mkdir()
    (tmp_path / "results" / "bench" / "cost.json").write_text(json.dumps({"results": COSTS}))
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("before\n<!-- results: made by x -->\nold\n<!-- /results -->\nafter\n")
    return tmp_path


def test_the_page_and_the_readme_of_some_runs(checkout):
    results.write(kept.runs(checkout / "results/runs"), checkout)
    page, readme = (checkout / "docs/results.md").read_text(), (checkout / "README.md").read_text()
    assert "| `constant70_p` | 1,241 | 1 | 100" in page and "| 7.5 | 0.35 | 0.15 | 2.4 |" in page  # 1.2 hours, 2 cores
    assert "| `decreasing` |  |  | not run yet |" in page and "## Pong\nNot run yet." in page
    assert "one seed suggests yes" in page and "Python 3.12.1, jax 0.11.2, a processor." in page
    assert readme.startswith("before\n<!-- results: made by x -->\nOn Breakout") and "\nold" not in readme
    assert "a learned gaze scores 0.83 of what" in readme  # less 1.7 of random play
    assert "It has 2.6 times the score of a gaze frozen in the centre.\n" in readme
    assert "| gaze frozen (`constant70_p_packed-frozen`) |" in readme
    assert "| whole frame (`nonfoa`) | 6,400 | 1 | 120 [" in readme and readme.count("| gaze ") == 2
    assert "\n<!-- /results -->\nafter\n" in readme and "In these runs" not in readme
    verdicts = "Do the paper's 12 claims hold on Breakout? Yes for 3, no for 1, open for 0, as far as so few seeds"
    assert verdicts in readme and "Runs for 8 are missing." in readme
    for link in ("breakout-gaze.png", "breakout-constant.png", "breakout-heat-constant70.png"):
        assert f"(results/{link})" in page and (checkout / "docs/results" / link).stat().st_size > 5000


def test_the_readme_names_the_best_gaze_once_all_sensors_were_run(checkout):
    runs = checkout / "results/runs"
    scores = {"constant50_sub1": 30, "constant50_sub2": 110, "decreasing": 70, "decreasing_p": 80}
    for name, mean in scores.items():
        assert "scores best" not in results.block(results.by_game(kept.runs(runs)), [])
        keep_run(runs, ["game=breakout", f"experiment={name}_packed"], mean)
    words = " ".join(results.block(results.by_game(kept.runs(runs)), []).split())
    assert "`constant50_sub2` scores best: 0.92 of the whole frame, from 625 values." in words  # 108.3 of 118.3


def test_the_readme_compares_with_a_gaze_frozen_low_too(checkout):
    words = ["game=breakout", "experiment=constant70_p_packed", "gaze=frozen", "gaze.start=[45,40]"]
    keep_run(checkout / "results/runs", [*words, "name=constant70_p_packed-frozen-low"], 50)
    block = results.block(results.by_game(kept.runs(checkout / "results/runs")), [])
    words = " ".join(block.split())
    assert "2.6 times the score of a gaze frozen in the centre and 2 times that of one frozen low." in words  # of 48.3
    assert "| gaze frozen low (`constant70_p_packed-frozen-low`) |" in block


def test_the_readme_says_what_the_canvas_scores(checkout):
    runs = checkout / "results/runs"
    assert "canvas" not in results.block(results.by_game(kept.runs(runs)), [])
    keep_run(runs, ["game=breakout", "experiment=constant70_p"], 60)
    words = " ".join(results.block(results.by_game(kept.runs(runs)), []).split())
    assert "On the paper's canvas a learned gaze has 0.49 of the whole frame's score." in words  # 58.3 of 118.3


def test_without_runs_the_readme_says_so():
    assert "not run yet" in results.page({}, []) and results.block({}, []) == "Not run yet.\n"


def test_runs_of_another_kind_are_not_compared(checkout):
    keep_run(checkout / "results/runs", ["game=breakout", "experiment=decreasing_packed", "learner.num_epochs=3"], 50)
    with pytest.raises(ConfigError, match="decreasing_packed-s0.*the same learner.num_epochs as in"):
        results.by_game(kept.runs(checkout / "results/runs"))


def test_a_run_that_is_not_compared_has_no_ratio_and_no_word_on_the_learner(checkout):
    words = ["game=breakout", "experiment=constant70", "learner.num_epochs=3", "name=aaa"]
    keep_run(checkout / "results/runs", words, 50, steps=9_000_000)
    page = results.page(results.by_game(kept.runs(checkout / "results/runs")), [])
    assert "On Breakout the learner" not in page
    cells = next(line for line in page.splitlines() if line.startswith("| `aaa, canvas`")).split("|")
    assert cells[4].startswith(" 50") and not cells[5].strip()


@pytest.mark.parametrize(
    ("words", "seed", "message"),
    [
        (["name=constant70_p_packed"], 0, "is of 1,000 env_steps; accepted is 3,000,000"),
        (["gaze=random", "name=decreasing_packed"], 0, "has a random gaze; accepted is name=decreasing_packed-random"),
        (["gaze=frozen", "name=constant70_p_packed-frozen-low"], 0, "a frozen gaze; .*constant70_p_packed-frozen$"),
        (["gaze.cost=1", "name=decreasing_packed"], 0, "a priced gaze; accepted is name=decreasing_packed-priced$"),
        (["name=constant70_p_packed-frozen-low"], 0, "a learned gaze; accepted is name=constant70_p_packed$"),
        (
            ["gaze=frozen", "gaze.start=[35,40]", "name=constant70_p_packed-frozen-low"],
            *(0, "has a frozen-elsewhere gaze"),
        ),
    ],
)
def test_seeds_of_one_name_are_of_one_kind(checkout, words, seed, message):
    runs = checkout / "results/runs"
    keep_run(runs, ["game=breakout", "experiment=constant70_p_packed", *words], 50, seed=seed + 1, steps=1000)
    with pytest.raises(ConfigError, match=message):
        results.by_game(kept.runs(runs))


def test_core_hours_are_those_of_the_mean_speed(checkout):
    path = keep_run(checkout / "results/runs", ["game=breakout", "experiment=nonfoa"], 120, seed=1)
    facts = json.loads((path / "run.json").read_text())
    (path / "run.json").write_text(json.dumps(facts | {"cores": 6}))
    seeds = results.by_game(kept.runs(checkout / "results/runs"))["breakout"].runs["nonfoa"]
    assert [run.time[-1] for run in seeds] == pytest.approx([4 * STEPS[-1] / 700] * 2)


def test_the_page_says_where_the_learner_was_not_todays(checkout):
    keep_run(checkout / "results/runs", ["game=pong", "experiment=nonfoa", "learner.num_epochs=3"], 5)
    page = results.page(results.by_game(kept.runs(checkout / "results/runs")), [])
    assert "\nOn Pong the learner was today's default with `learner.num_epochs=3`.\n" in page
    assert "On Breakout the learner" not in page


def test_runs_of_another_length_are_not_compared(checkout):
    keep_run(checkout / "results/runs", ["game=breakout", "experiment=decreasing_packed"], 50, steps=9_000_000)
    with pytest.raises(ConfigError, match="decreasing_packed-s0: is of 9,000,000 env_steps; accepted is 3,000,000, as"):
        results.by_game(kept.runs(checkout / "results/runs"))


def test_the_page_in_the_repository_is_what_its_runs_say():
    games = results.by_game(kept.runs(results.ROOT / "results/runs"))
    costs = json.loads((results.ROOT / "results/bench/cost.json").read_text())["results"]
    assert (results.ROOT / "docs/results.md").read_text() == results.page(games, costs)
    text, readme = results.block(games, costs), (results.ROOT / "README.md").read_text()
    assert fill(readme, text) == readme


def test_the_readme_says_where_the_learner_was_not_todays(checkout):
    for path in (checkout / "results/runs/breakout").iterdir():
        config = path / "config.yaml"
        config.write_text(config.read_text().replace("normalize_advantages: false", "normalize_advantages: true"))
    block = " ".join(results.block(results.by_game(kept.runs(checkout / "results/runs")), []).split())
    assert "In these runs the learner was today's default with `learner.normalize_advantages=true`. " in block
