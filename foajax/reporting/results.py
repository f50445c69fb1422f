"""Makes docs/results.md and the README's block from kept runs: figures, tables and the paper's claims."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from foajax.config import shipped
from foajax.config.parse import flatten, refuse, to_mapping
from foajax.config.schema import LearnerConfig
from foajax.reporting import claims, kept, search
from foajax.reporting.claims import CLAIMS, Claim, Finding, Game
from foajax.reporting.curves import PAPER_NAMES, RunData, colours_of, draw_curves, save
from foajax.reporting.groups import PRESETS, check_lengths, check_seeds, differing_keys, games_of
from foajax.reporting.markdown import fill, table
from foajax.reporting.scores import Interval
from foajax.sensors.registry import make_sensor
from foajax.viewing import heatmap

ROOT = shipped.kept_runs().parents[1]
GAMES = {"breakout": "Breakout", "pong": "Pong", "beam_rider": "Beam Rider"}
_GAZES = {
    "nonfoa": "whole frame",
    "constant70_p": "gaze learned",
    "constant70_p-frozen": "gaze frozen",
    "constant70_p-frozen-low": "gaze frozen low",
    "constant70_p-random": "gaze random",
    "constant70_p-scripted": "gaze scripted",
    "constant70_p-priced": "gaze learned at a price",
}
_TIMES = {  # whose score a learned gaze has so many times
    "constant70_p-frozen": "the score of a gaze frozen in the centre",
    "constant70_p-frozen-low": "that of one frozen low",
    "constant70_p-random": "that of a random one",
    "constant70_p-scripted": "that of one that scans the lower half",
    "constant70_p-priced": "that of a learned one that pays for each move",
}
FIGURES: dict[str, tuple[str, Mapping[str, str]]] = {  # title, and whose curves by which names
    "constant": ("constant resolution (Fig. 7)", {name: name for name in PRESETS["constant"]}),
    "decreasing": ("decreasing resolution (Fig. 8)", {name: name for name in PRESETS["decreasing"]}),
    "peripheral": ("peripheral vision (Fig. 9)", {name: name for name in PRESETS["peripheral"]}),
    "gaze": ("the whole frame, and a fifth of it", _GAZES),
}
_COMPARED = {*PAPER_NAMES, *_GAZES, "logpolar", "constant70_p, canvas", "decreasing, canvas"}
_AXES = {"env_steps": (1e6, "million decisions"), "time": (3600.0, "core hours")}


def by_game(runs: Sequence[RunData]) -> dict[str, Game]:
    """Groups kept runs by game; their `time` becomes core seconds, at the mean speed of an experiment's seeds.

    Raises:
      ConfigError: runs of a game that are compared differ in more than sensor, gaze and seed; a seed is there twice;
        the gaze is another than a run's name says.
    """
    games = {}
    for name, groups in games_of(runs, None).items() if runs else ():
        if name not in GAMES:
            continue
        labelled = {_label(seeds[0]): _in_core_time(seeds) for seeds in groups.values()}
        for label, seeds in labelled.items():
            check_seeds(seeds)
            _check_gaze(label, seeds[0])
        _check_protocol([labelled[each] for each in labelled if each in _COMPARED])
        heats = {label: list(filter(None, map(_heat, seeds))) for label, seeds in labelled.items()}
        games[name] = Game(name, labelled, heats)
    return games


def _label(run: RunData) -> str:
    """Returns the experiment's name without `_packed`; adds "canvas" if its sensor could be packed and is not."""
    name = run.config.name.replace("_packed", "")
    is_canvas = make_sensor(run.config.sensor).in_place and name != "nonfoa"
    return f"{name}, canvas" if is_canvas else name


def _in_core_time(seeds: Sequence[RunData]) -> list[RunData]:
    mean = np.mean([run.time[-1] * kept.record(run)["cores"] for run in seeds])
    return [run._replace(time=run.time / run.time[-1] * mean) for run in seeds]


def _heat(run: RunData) -> heatmap.HeatMap | None:
    return heatmap.of_run(run.path, kept.record(run)["env_steps"])


def _check_gaze(label: str, run: RunData) -> None:
    """Raises `ConfigError` if the gaze of a run that is compared is another than the end of its name says."""
    kind: str = run.config.gaze.mode
    if kind == "frozen" and run.config.gaze.start != "centre":
        lowest, middle = heatmap.bounds(run.config)[1][0], run.config.env.frame_shape[1] // 2
        kind = "frozen-low" if run.config.gaze.start == (lowest, middle) else "frozen-elsewhere"
    elif kind == "learned" and run.config.gaze.cost:
        kind = "priced"
    end = "" if kind in ("learned", "none") else f"-{kind}"
    if label in _COMPARED and end != "".join(label.partition("-")[1:]):
        name = f"{run.config.name.partition('-')[0]}{end}"
        raise refuse(str(run.path), accepted=f"name={name}", why=f"has a {kind} gaze")


def _check_protocol(groups: Sequence[Sequence[RunData]]) -> None:
    first = [seeds[0] for seeds in groups]
    for key, values in differing_keys(first).items():
        if not key.startswith(("sensor.", "gaze.")):
            other = next(run for run, value in zip(first, values, strict=True) if value != values[0])
            accepted = f"the same {key} as in {first[0].path}"
            raise refuse(str(other.path), accepted=accepted, why="is compared with runs of another kind")
    check_lengths(first)


def page(games: Mapping[str, Game], costs: Sequence[Mapping[str, Any]]) -> str:
    """Makes the text of docs/results.md.

    Args:
      games: kept runs, by game.
      costs: what `foajax cost` measured of each experiment.
    """
    findings = {
        claim.title: {game: claims.ask(claim, games.get(game, Game(game, {}))) for game in GAMES} for claim in CLAIMS
    }
    parts = [
        "# Results",
        _INTRODUCTION,
        "## Does the paper hold?",
        _verdicts([claim for claim in CLAIMS if claim.says], findings, "the paper's claim"),
        "Questions of ours:",
        _verdicts([claim for claim in CLAIMS if not claim.says], findings, "question"),
        "How a verdict is reached:",
        claims.RULES,
        "## Claim by claim",
        *(_section(claim, findings[claim.title]) for claim in CLAIMS),
        *(_game(games[game], costs) if game in games else f"## {GAMES[game]}\nNot run yet." for game in GAMES),
        _SENSORS,
        _protocol(games),
    ]
    return "\n\n".join(parts) + "\n"


_INTRODUCTION = """\
This page compares the paper's seven sensors on its three games, and adds controls that the paper does not show.
Runs that are missing are marked *not run yet*. `foajax reproduce` makes the runs. `foajax keep` keeps them and writes
this page, so no figure on it is written by hand. [Compare sensors](experiments.md) says what each sensor is."""

_SENSORS = """\
## What the sensors show (Figs. 5 and 6)
Left: the frame with the focal area and the focal point. Right: what the sensor gives, drawn at its place in the frame.

![Constant: two places of the gaze](results/constant.png)

![Decreasing(P): two places of the gaze](results/decreasing_p.png)

`foajax show sensor=constant70 points=[[35,35],[45,45]] out=docs/results/constant.png` drew the first figure, the same
command with `decreasing_p` the second."""


_PROTOCOL = """\
## How the runs were made
- **Training**: the default learner, if nothing else is said below, and 3,000,000 decisions (Pong 1,500,000) of 4
  frames each. A sensor that has a packed layout uses it.
- **Score**: 100 whole games of the final policy, with sampled actions.
- **Curves**: each point is the mean of the last 100 games of training, with no other smoothing. 500 points of each
  curve are kept. With several seeds, thin lines are seeds, the thick line is their mean, and the band is the mean's
  95 % interval by bootstrap over seeds. Against core hours, all seeds of an experiment are drawn at their mean speed.

[results/runs](../results/runs/README.md) has commands, commits and machines of all runs."""


def _protocol(games: Mapping[str, Game]) -> str:
    facts = [kept.record(run) for game in games.values() for seeds in game.runs.values() for run in seeds]

    def each(values: Iterable[str]) -> str:
        return ", ".join(sorted(set(values)))

    text = _PROTOCOL
    for game in games.values():
        if other := _other_learner(game):
            text += f"\n\nOn {GAMES[game.name]} {other}"
    if facts:
        pythons, cpus = each(fact["python"] for fact in facts), each(fact["cpu"] for fact in facts)
        text += f"\n\nPython {pythons}, jax {each(fact['packages']['jax'] for fact in facts)}, {cpus}."
    return text


def _other_learner(game: Game) -> str:
    """Says how the learner of the runs that are compared, which share it, differs from the default; else ""."""
    first = next((game.runs[label][0] for label in game.runs if label in _COMPARED), None)
    then = flatten(to_mapping(first.config.learner)) if first else ()
    today = dict(flatten(to_mapping(LearnerConfig())))
    words = [f"`learner.{key}={json.dumps(value)}`" for key, value in then if value != today[key]]
    return f"the learner was today's default with {', '.join(words)}." if words else ""


def _verdicts(chosen: Sequence[Claim], findings: Mapping[str, Mapping[str, Finding]], head: str) -> str:
    rows = [
        [
            f"[{claim.title}](#{_anchor(claim.title)})",
            *(_bold(finding.verdict) for finding in findings[claim.title].values()),
        ]
        for claim in chosen
    ]
    return table([head, *GAMES.values()], rows)


def _bold(verdict: str) -> str:
    return f"**{verdict}**" if verdict in ("holds", "does not hold") else verdict


def _anchor(title: str) -> str:
    """Makes a heading's anchor as GitHub does."""
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def _section(claim: Claim, findings: Mapping[str, Finding]) -> str:
    says = f"The paper: “{claim.says}”\n\n" if claim.says else ""
    seen = [
        f"- {GAMES[game]}: {_bold(finding.verdict)}. {'. '.join(finding.seen)}."
        for game, finding in findings.items()
        if finding.verdict != claims.NOT_RUN
    ]
    return f"### {claim.title}\n{says}{claim.asks}\n\n" + ("\n".join(seen) or "Not run yet.")


def _game(game: Game, costs: Sequence[Mapping[str, Any]]) -> str:
    name = GAMES[game.name]
    parts = [f"## {name}", _scores(game, costs)]
    for file, (title, labels) in FIGURES.items():
        if any(label in game.runs for label in labels):
            left = [f"`{label}`" for label in labels if label not in game.runs]
            parts.append(f"![{name}: {title}](results/{game.name}-{file}.png)")
            parts += [f"Not run yet: {', '.join(left)}."] if left else []
    for label in claims.WATCHED:
        if game.heats.get(label):
            parts.append(f"![{name}: where {label} looks (Fig. 10)](results/{game.name}-heat-{label}.png)")
    return "\n\n".join(parts)


_COLUMNS = ["agent", "pixel values", "seeds", "score", "of `nonfoa`", "MFLOP", "ms alone", "ms of 32", "core hours"]
_SCORES = """\
- **score**: mean of 100 games, in brackets its 95 % interval by bootstrap over seeds, or over the games where there
  is one seed. Of two or three seeds it goes from the worst to the best.
- **of `nonfoa`**: ratio of the scores, each less that of random play.
- **MFLOP, ms alone, ms of 32**: arithmetic of one decision, and its time on a CPU, alone and as one of 32 at once
  ([cost.json](../results/bench/cost.json)).
- **core hours**: how long training took, times cores. Other work on the machine lengthens them."""


def _scores(game: Game, costs: Sequence[Mapping[str, Any]]) -> str:
    order = [*PAPER_NAMES, *(label for label in game.runs if label not in PAPER_NAMES)]
    rows = [
        _row(game, label, costs) if label in game.runs else [f"`{label}`", "", "", claims.NOT_RUN, "", *_cost(None), ""]
        for label in order
    ]
    return f"{table(_COLUMNS, rows)}\n\n{_SCORES}"


def _row(game: Game, label: str, costs: Sequence[Mapping[str, Any]]) -> list[str]:
    runs = game.runs[label]
    config = runs[0].config
    comparable = "nonfoa" in game.runs and label in _COMPARED - {"nonfoa"}
    measured = (config.name.split("-")[0], config.network.torso)
    return [
        f"`{label}`",
        f"{make_sensor(config.sensor).count(config.env.frame_shape).nominal:,}",
        str(len(runs)),
        str(claims.score(runs)),
        str(claims.over(_worth(game, label), _worth(game, "nonfoa"))) if comparable else "",
        *_cost(next((each for each in costs if (each["experiment"], each["torso"]) == measured), None)),
        f"{np.mean([run.time[-1] for run in runs]) / 3600:.1f}",
    ]


def _worth(game: Game, label: str) -> Interval:
    """Returns an experiment's score above that of random play, which ratios are made of."""
    return claims.above_chance(claims.score(game.runs[label]), game.name)


def _cost(record: Mapping[str, Any] | None) -> list[str]:
    if record is None:
        return ["", "", ""]
    alone, together = record["decision_us_batch1"] / 1e3, record["decision_us_batch32"] / 32e3
    return [f"{record['decision_flops'] / 1e6:.1f}", f"{alone:.2f}", f"{together:.2f}"]


def block(games: Mapping[str, Game], costs: Sequence[Mapping[str, Any]]) -> str:
    """Makes the README's block: the whole frame and several gazes on Breakout, once the first three were run."""
    game = games.get("breakout", Game("breakout", {}))
    there = [label for label in _GAZES if label in game.runs]
    if there[:3] != list(_GAZES)[:3]:
        return "Not run yet.\n"
    whole, learned, *others = (_worth(game, label).value for label in there)
    *first, last = (
        f"{learned / other:.2g} times {_TIMES[label]}" for label, other in zip(there[2:], others, strict=True)
    )
    text = (
        f"On Breakout a learned gaze scores {learned / whole:.2f} of what an agent scores that sees the whole frame, "
        f"from a fifth of its pixel values. It has {', '.join(first) + ' and ' if first else ''}{last}."
        f"{_canvas(game)}{_best(game)}"
    )
    rows = []
    for label in there:
        name = game.runs[label][0].config.name  # as it is typed, with `_packed`
        rows.append([f"{_GAZES[label]} (`{name}`)", *_row(game, label, costs)[1:5]])
    other = _other_learner(game)
    legend = (
        "Score: mean of 100 whole games. Brackets: 95 % intervals over the games where there is one seed; from the "
        "worst to the best of two or three seeds. Ratios are of scores above random play."
        f"{other and f' In these runs {other}'}"
    )
    return (
        f"{textwrap.fill(text, 120)}\n\n"
        "![A learned gaze, gazes that do not learn, and the whole frame](docs/results/breakout-gaze.png)\n\n"
        f"{table(['agent', *_COLUMNS[1:5]], rows)}\n\n"
        f"{textwrap.fill(legend, 120)}\n\n"
        f"{_verdicts_in_words(game)} [All results](docs/results.md).\n"
    )


def _verdicts_in_words(game: Game) -> str:
    verdicts = [claims.ask(claim, game).verdict for claim in CLAIMS if claim.says]
    missing = verdicts.count(claims.NOT_RUN)
    yes, no = (sum(verdict.endswith(ends) for verdict in verdicts) for ends in ((" yes", "holds"), (" no", "not hold")))
    few = any("seed" in verdict for verdict in verdicts)
    return (
        f"Do the paper's {len(verdicts)} claims hold on Breakout? Yes for {yes}, no for {no}, open for "
        f"{len(verdicts) - yes - no - missing}{', as far as so few seeds can tell' if few else ''}."
        + (f" Runs for {missing} are missing." if missing else "")
    )


def _canvas(game: Game) -> str:
    """Says what a learned gaze scores on the paper's canvas; "" before that was run."""
    label = "constant70_p, canvas"
    if label not in game.runs:
        return ""
    share = _worth(game, label).value / _worth(game, "nonfoa").value
    return f" On the paper's canvas a learned gaze has {share:.2f} of the whole frame's score."


def _best(game: Game) -> str:
    """Says which of the paper's sensors with a gaze scores best; "" before all of them were run."""
    if not game.runs.keys() >= PAPER_NAMES.keys():
        return ""
    scores = {label: _worth(game, label).value for label in PAPER_NAMES}
    whole = scores.pop("nonfoa")
    best = max(scores, key=scores.__getitem__)
    config = game.runs[best][0].config
    values = make_sensor(config.sensor).count(config.env.frame_shape).nominal
    share = f"{scores[best] / whole:.2f} of the whole frame"
    return f" Of the paper's six sensors with a gaze `{best}` scores best: {share}, from {values:,} values."


def draw(games: Mapping[str, Game], directory: Path) -> None:
    """Draws the figures of the page."""
    for game in games.values():
        title = GAMES[game.name]
        for file, (what, labels) in FIGURES.items():
            if there := {label: shown for label, shown in labels.items() if label in game.runs}:
                groups = {shown: game.runs[label] for label, shown in there.items()}
                colours = {there[label]: colour for label, colour in colours_of(there).items()}
                save(draw_curves(groups, f"{title}: {what}", colours, _AXES), directory / f"{game.name}-{file}.png")
        for label in claims.WATCHED:
            if heats := game.heats.get(label):
                save(heatmap.draw(heats[0], f"{label} on {title}"), directory / f"{game.name}-heat-{label}.png")


def write(runs: Sequence[RunData], root: Path = ROOT) -> None:
    """Writes docs/results.md, its figures, the README's block and docs/search.md of a checkout from its kept runs."""
    games = by_game(runs)
    costs = json.loads((root / "results" / "bench" / "cost.json").read_text())["results"]
    (root / "docs" / "results").mkdir(exist_ok=True)
    draw(games, root / "docs" / "results")
    (root / "docs" / "results.md").write_text(page(games, costs))
    readme = root / "README.md"
    readme.write_text(fill(readme.read_text(), block(games, costs)))
    search.write(runs, root / "docs")
