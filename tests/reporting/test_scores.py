"""Interquartile means and bootstrap intervals against numbers worked out by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from foajax.reporting.scores import Interval, interval, iqm, normalised


@pytest.mark.parametrize(
    "scores, expected",
    [
        ([5.0], 5.0),
        ([1.0, 2.0, 6.0], 3.0),  # less than a score is cut from each end
        ([100.0, 2.0, 4.0, -50.0], 3.0),
        ([8.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], 4.5),
        ([0.0, 0.0, 1.0, 2.0, 3.0, 90.0], 1.5),  # 6 / 4 rounded down: one from each end
    ],
)
def test_the_interquartile_mean(scores, expected):
    assert iqm(np.array(scores)) == pytest.approx(expected)


def test_scores_of_several_games_are_cut_together():
    strata = [np.array([0.0, 1.0]), np.array([10.0, 20.0])]
    assert interval(strata, iqm).value == pytest.approx((1 + 10) / 2)


def test_an_interval_is_the_quantiles_of_all_resamples():
    """Two games with two runs each: the 16 resamples are few enough to be listed."""
    strata = [np.array([0.0, 1.0]), np.array([10.0, 14.0])]
    means = [
        np.mean([*first, *second])
        for first in itertools.product(strata[0], repeat=2)
        for second in itertools.product(strata[1], repeat=2)
    ]
    found = interval(strata, np.mean)
    assert found.value == pytest.approx(6.25)
    assert (found.low, found.high) == (min(means), max(means)) == (5.0, 7.5)  # each in 1 of 16, more than 2.5 %


def test_a_resample_stays_within_its_game():
    strata = [np.array([1.0, 1.0, 1.0]), np.array([5.0])]
    assert interval(strata, np.mean) == Interval(2.0, 2.0, 2.0)


def test_the_interval_of_a_mean_is_that_of_theory():
    """Sixty-four scores of deviation 8: the mean's deviation is 1, its 95 % interval +- 1.96."""
    scores = np.random.default_rng(1).normal(size=64)
    scores = 100 + 8 * (scores - scores.mean()) / scores.std()
    found = interval([scores], np.mean)
    assert found.low == pytest.approx(100 - 1.96, abs=0.2) and found.high == pytest.approx(100 + 1.96, abs=0.2)


def test_normalised_scores():
    np.testing.assert_allclose(normalised("breakout", np.array([1.7, 30.5, 59.3])), [0, 1, 2])
    assert normalised("asterix", np.array([1.0])) is None


def test_how_an_interval_is_written():
    assert str(Interval(12.345678, 10.0, 15.5)) == "12.3 [10, 15.5]"
    assert str(Interval(12345.6, 999.0, np.inf)) == "12,346 [999, inf]"
    assert str(Interval(3.0, 3.0, 3.0)) == "3"
