"""Tests the paper's claims, and some of our own, on kept runs: the numbers, and a verdict.

Each claim says within which bounds a number has to lie: a ratio of two scores, or a share. `judge` has the rules, and
`RULES` says them in words.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from foajax.reporting.curves import RunData, on_common_axis
from foajax.reporting.scores import CONFIDENCE, QUANTILES, REFERENCE, Interval, interval, resampled
from foajax.viewing.heatmap import HeatMap

_ANYTHING = Interval(math.nan, 0.0, math.inf)  # a ratio of which nothing is known
SEEDS = 3  # of each experiment, for a verdict
LEARNED = 0.02  # of the best score of a game, both above random play: who has less has not learned the game
NOT_RUN = "not run yet"
_CHANCE = ", ".join(f"{low} on {game}" for game, (low, _) in REFERENCE.items() if game != "seek")
RULES = f"""\
- A score is the mean of 100 whole games of the final policy, with unclipped rewards.
- Before two scores are divided, the score of random play is subtracted from both:
  {_CHANCE}.
- Brackets hold {100 * CONFIDENCE:.0f} % intervals by bootstrap over seeds. With one seed, the interval of a score
  is over its 100 games and says nothing about other seeds. Numbers from the curve or the heat map of one seed have no
  interval.
- The interval of a ratio goes from the smallest to the largest ratio of values in the two intervals. So one score
  counts as higher than another only if their intervals do not overlap. For how much longer learning takes, it is by
  bootstrap over the seeds of both.
- A claim *holds* if the whole interval is within the bounds of the claim. It *does not hold* if the whole interval is
  outside. Otherwise the runs *cannot tell*. A claim about two pairs has to hold for both.
- An agent whose final score is less than {100 * LEARNED:.0f} % of the best in the table, both above random play, has
  not learned the game. Two such agents *cannot tell*; for how much longer learning takes, one is enough.
- Verdicts need {SEEDS} seeds of each experiment; fewer seeds only *suggest* one. Of two or three seeds, an interval
  goes from the worst to the best; the true mean lies in it one time in two, or three times in four. If two experiments
  of {SEEDS} seeds are equal, the one that is claimed to be better seems so by chance in one comparison of 20.
- *{NOT_RUN.capitalize()}* means that a run which the claim needs is missing."""


class Game(NamedTuple):
    """The kept runs of one game, by the experiment's name without `_packed`."""

    name: str
    runs: Mapping[str, Sequence[RunData]]  # seeds of each
    heats: Mapping[str, Sequence[HeatMap]] = {}  # of the seeds that have one


class Part(NamedTuple):
    """One number that a claim is about."""

    found: Interval
    seeds: int  # that it rests on
    seen: str  # the same in words


class Claim(NamedTuple):
    """A claim, which holds if all its parts lie between `low` and `high`."""

    title: str
    says: str | None  # the paper's words; None where the question is ours
    asks: str  # what is compared, and with which bounds
    low: float
    high: float
    parts: Callable[[Game], list[Part | None]]  # None where a run is missing


class Finding(NamedTuple):
    """The verdict of one game's runs on a claim."""

    verdict: str
    seen: list[str]


def ask(claim: Claim, game: Game) -> Finding:
    """Tests a claim on the runs of a game."""
    parts = claim.parts(game)
    return Finding(judge(parts, claim.low, claim.high), [part.seen for part in parts if part is not None])


def judge(parts: Sequence[Part | None], low: float, high: float) -> str:
    """Reaches the verdict by `RULES`."""
    there = [part for part in parts if part is not None]
    if len(there) < len(parts):
        return NOT_RUN
    within = all(low < part.found.low and (part.found.high < high or high == math.inf) for part in there)
    outside = any(part.found.high <= low or high <= part.found.low for part in there)
    seeds = min(part.seeds for part in there)
    if seeds >= SEEDS:
        return "holds" if within else "does not hold" if outside else "cannot tell"
    who, s = ("one seed", "s") if seeds == 1 else (f"{seeds} seeds", "")
    return f"{who} suggest{s} yes" if within else f"{who} suggest{s} no" if outside else f"{who} cannot tell"


def score(runs: Sequence[RunData]) -> Interval:
    """Averages the scores over seeds. With one seed, the interval is over its games."""
    if len(runs) == 1:
        return interval([np.array((runs[0].evaluation or {})["returns"], float)], np.mean)
    return interval([np.array([run.final_score for run in runs])], np.mean)


def training_score(runs: Sequence[RunData], *, share: float) -> Interval:
    """Averages the curves over the first `share` of the training and over seeds."""
    steps = [np.linspace(0, share * run.env_steps[-1], 300) for run in runs]
    means = [np.interp(x, run.env_steps, run.score).mean() for x, run in zip(steps, runs, strict=True)]
    return interval([np.array(means)], np.mean)


def chance(game: str) -> float:
    """Returns the score of random play, 0 in a game without a reference."""
    return REFERENCE.get(game, (0.0, 0.0))[0]


def above_chance(score: Interval, game: str) -> Interval:
    """Subtracts the score of random play."""
    return Interval(*(each - chance(game) for each in score))


def over(a: Interval, b: Interval) -> Interval:
    """Divides a by b, negative values counted as 0; the interval goes from the smallest to the largest ratio.

    What is positive divided by 0 is infinite, 0 divided by 0 anything from 0 to infinity.
    """
    a, b = (Interval(*(max(each, 0.0) for each in given)) for given in (a, b))
    value, low, high = (x / y if y > 0 else math.inf for x, y in ((a.value, b.value), (a.low, b.high), (a.high, b.low)))
    return Interval(value, low if a.low > 0 else 0.0, high)


def times_longer(slow: Sequence[RunData], fast: Sequence[RunData], axis: str) -> Interval | None:
    """Compares how far along the axis `slow` and `fast` first reach the lower of their last scores: slow / fast.

    Curves are means over seeds; the interval is by bootstrap over both. None if the curves of a group do not overlap.
    """
    first, second = on_common_axis(slow, axis), on_common_axis(fast, axis)
    if first is None or second is None:
        return None
    (slow_x, slow_curves), (fast_x, fast_curves) = first, second

    def ratio(slow_mean: np.ndarray, fast_mean: np.ndarray) -> Float[np.ndarray, "n"]:
        level = np.minimum(slow_mean[:, -1:], fast_mean[:, -1:])
        return slow_x[np.argmax(slow_mean >= level, axis=1)] / fast_x[np.argmax(fast_mean >= level, axis=1)]

    random = np.random.default_rng(0)
    drawn = [resampled(curves, random).mean(axis=1) for curves in (slow_curves, fast_curves)]
    low, high = np.quantile(ratio(*drawn), QUANTILES)
    value = ratio(slow_curves.mean(axis=0, keepdims=True), fast_curves.mean(axis=0, keepdims=True))
    return Interval(float(value[0]), float(low), float(high))


def _learned(name: str, game: Game) -> bool:
    """Tells whether the agents of an experiment have learned the game, by their final scores."""
    above = {each: np.mean([run.final_score for run in runs]) - chance(game.name) for each, runs in game.runs.items()}
    return bool(above[name] >= LEARNED * max(above.values()))


def _compare(
    measure: Callable[[Sequence[RunData]], Interval], what: str, pairs: Sequence[tuple[str, str]], game: Game
) -> list[Part | None]:
    """Divides a measure of one experiment by that of another, both less random play, pair by pair."""
    parts: list[Part | None] = []
    for pair in pairs:
        if not all(name in game.runs for name in pair):
            parts.append(None)
            continue
        a, b = (measure(game.runs[name]) for name in pair)
        learned = any(_learned(name, game) for name in pair)
        found = over(above_chance(a, game.name), above_chance(b, game.name)) if learned else _ANYTHING
        seen = f"{what}: `{pair[0]}` {a}, `{pair[1]}` {b}; {f'ratio {found}' if learned else 'neither has learned'}"
        parts.append(Part(found, min(len(game.runs[name]) for name in pair), seen))
    return parts


def _scores(*pairs: tuple[str, str]) -> Callable[[Game], list[Part | None]]:
    return functools.partial(_compare, score, "Score", pairs)


def _training(share: float, *pairs: tuple[str, str]) -> Callable[[Game], list[Part | None]]:
    what = "Mean score in training" if share == 1 else f"Mean score in the first {100 * share:.0f} % of training"
    return functools.partial(_compare, functools.partial(training_score, share=share), what, pairs)


def _longer(slow: str, fast: str) -> Callable[[Game], list[Part | None]]:
    def parts(game: Game) -> list[Part | None]:
        if slow not in game.runs or fast not in game.runs:
            return [None]
        groups = game.runs[slow], game.runs[fast]
        seeds = min(map(len, groups))
        for name in (slow, fast):
            if not _learned(name, game):
                return [Part(_ANYTHING, seeds, f"`{name}` has not learned")]
        steps, hours = (times_longer(*groups, axis) for axis in ("env_steps", "time"))
        if steps is None or hours is None:
            return [None]
        seen = f"`{slow}` takes {steps} times the steps of `{fast}`, and {hours} times the core hours"
        return [Part(steps, seeds, seen)]

    return parts


def _gaze(number: str, what: str) -> Callable[[Game], list[Part | None]]:
    """Takes a number from the heat maps of the two sensors of the paper's Fig. 10."""

    def part(name: str, heats: Sequence[HeatMap]) -> Part | None:
        if not heats:
            return None
        found = interval([np.array([getattr(heat, number) for heat in heats])], np.mean)
        return Part(found, len(heats), f"{what}: `{name}` {found}")

    return lambda game: [part(name, game.heats.get(name, ())) for name in WATCHED]


WATCHED = ("constant70", "decreasing_p")  # in Fig. 10
_PERIPHERY = (("constant70_p", "constant70"), ("decreasing_p", "decreasing"))

CLAIMS = (
    Claim(
        "Lower resolution at 50x50 hurts",
        "lowering the resolution for a 50 × 50 focal area deteriorates performance",
        "Score of `constant50_sub1` divided by that of `constant50_sub2`: above 1.",
        *(1.0, math.inf, _scores(("constant50_sub1", "constant50_sub2"))),
    ),
    Claim(
        "70x70 at half resolution beats 50x50 at full, with half the pixels",
        "the *Constant 70x70, sub2* model outperforms the *Constant 50x50, sub1* model even though only approximately "
        "half the amount of pixels are visible to the agent",
        "Score of `constant70` divided by that of `constant50_sub1`: above 1.",
        *(1.0, math.inf, _scores(("constant70", "constant50_sub1"))),
    ),
    Claim(
        "Decreasing resolution is about equal to constant",
        "The performances of the two models are quite similar",
        "Score of `decreasing` divided by that of `constant70`: 0.8 to 1.25.",
        *(0.8, 1.25, _scores(("decreasing", "constant70"))),
    ),
    Claim(
        "The outer ring helps",
        "the low resolution outer focal area does add valuable information to the model",
        "Score of `decreasing` divided by that of `constant50_sub1`: above 1.",
        *(1.0, math.inf, _scores(("decreasing", "constant50_sub1"))),
    ),
    Claim(
        "The periphery improves the score",
        "When the peripheral is added to the two previously mentioned RoI layers the performance is improved.",
        "Score of `constant70_p` divided by that of `constant70`, and `decreasing_p` by `decreasing`: above 1.",
        *(1.0, math.inf, _scores(*_PERIPHERY)),
    ),
    Claim(
        "The periphery makes learning faster",
        "both the *Constant(P) 70x70, sub2* model and the *Decreasing(P) 30-50-70* model are faster to train than "
        "their counterparts",
        "Mean score over the whole training, `constant70_p` divided by `constant70`, and `decreasing_p` by "
        "`decreasing`: above 1.",
        *(1.0, math.inf, _training(1.0, *_PERIPHERY)),
    ),
    Claim(
        "A fifth of the pixels is enough",
        "we can reduce the image data by a factor of 5 while still achieving similar game performance",
        "Score of `constant70_p` (1241 values) divided by that of `nonfoa` (6400 values): above 0.8.",
        *(0.8, math.inf, _scores(("constant70_p", "nonfoa"))),
    ),
    Claim(
        "Learning takes about 5 times longer",
        "The learning of the two policies took approx. 5 times longer",
        "Training steps of `constant70_p` divided by those of `nonfoa`, each until the lower of the two final scores: "
        "2.5 to 10.",
        *(2.5, 10.0, _longer("constant70_p", "nonfoa")),
    ),
    Claim(
        "A gaze slows the first learning",
        "the addition of the focus-of-attention algorithm generally deteriorates performance, particularly during the "
        "initial episodes",
        "Mean score over the first tenth of the training, `constant70` divided by `nonfoa`: below 1.",
        *(-math.inf, 1.0, _training(0.1, ("constant70", "nonfoa"))),
    ),
    Claim(
        "The gaze stays in the lower half",
        "the focal point is mostly kept centered at the bottom half of the screen",
        "Share of the decisions that have the focal point below the frame's middle, of `constant70` and of "
        "`decreasing_p`: above 0.5.",
        *(0.5, math.inf, _gaze("share_below", "Share below the middle")),
    ),
    Claim(
        "The gaze moves little",
        "the agent does not move its focal point very much",
        "Spread of the focal point divided by that of a gaze which is everywhere within its bounds equally often, of "
        "`constant70` and of `decreasing_p`: below 0.5. The bounds are narrow, 11x11 pixels, because the 70x70 window "
        "stays inside the frame.",
        *(-math.inf, 0.5, _gaze("relative_spread", "Relative spread")),
    ),
    Claim(
        "Without gaze control it is much worse",
        "without the gaze control and only a low-resolution image the performance was much worse",
        "Score of `constant70_p` with its gaze frozen in the centre, divided by that with a learned gaze: below 0.5.",
        *(-math.inf, 0.5, _scores(("constant70_p-frozen", "constant70_p"))),
    ),
    Claim(
        "A learned gaze beats one frozen low",
        None,
        "Score of `constant70_p` divided by that with its gaze frozen at the lower edge of its bounds, in the middle: "
        "above 1. A gaze frozen in the centre does not see Breakout's paddle sharply; this one does.",
        *(1.0, math.inf, _scores(("constant70_p", "constant70_p-frozen-low"))),
    ),
    Claim(
        "A learned gaze beats a random one",
        None,
        "Score of `constant70_p` divided by that with a random gaze: above 1.",
        *(1.0, math.inf, _scores(("constant70_p", "constant70_p-random"))),
    ),
    Claim(
        "A learned gaze beats a scripted one",
        None,
        "Score of `constant70_p` divided by that with a gaze that follows a fixed path: above 1.",
        *(1.0, math.inf, _scores(("constant70_p", "constant70_p-scripted"))),
    ),
    Claim(
        "A price for moving improves a learned gaze",
        None,
        "Score of `constant70_p` where each move of the gaze costs 0.01 of reward in training (`gaze.cost=0.01 "
        "gaze.cost_per=saccade`), divided by that where moving is free: above 1.",
        *(1.0, math.inf, _scores(("constant70_p-priced", "constant70_p"))),
    ),
    Claim(
        "Packed values score no less than the paper's canvas",
        None,
        "Score of `constant70_p` (packed) divided by that of the same sensor with an 80x80 canvas: above 0.8.",
        *(0.8, math.inf, _scores(("constant70_p", "constant70_p, canvas"))),
    ),
    Claim(
        "Packed rings score no less than the paper's canvas",
        None,
        "Score of `decreasing` (packed) divided by that of the same sensor with an 80x80 canvas: above 0.8. Packed, "
        "each ring is an image of its own, and the outer one gives few of the features; a canvas is one image.",
        *(0.8, math.inf, _scores(("decreasing", "decreasing, canvas"))),
    ),
    Claim(
        "A log-polar retina scores no less than squares of as many values",
        None,
        "Score of `logpolar` divided by that of `constant70` (1225 values each): above 0.8. The focal point of "
        "`logpolar` may be anywhere in the frame, that of `constant70` only where its window stays inside.",
        *(0.8, math.inf, _scores(("logpolar", "constant70"))),
    ),
)
