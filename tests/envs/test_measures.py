"""foajax.measures: the window of the last episodes, and the measures of search against hand-made tables."""

from __future__ import annotations

import numpy as np
import pytest

from foajax.envs.measures import FactsTracker, pooled, summarise


def table(**facts):
    """Facts of some episodes; what is not named is as in an episode that found its one target at once."""
    n = len(next(iter(facts.values())))
    ordinary = {
        **{"set_size": np.full(n, 8), "targets": np.ones(n, int), "right": np.ones(n, bool)},
        **{"decisions": np.ones(n, int), "fixations": np.ones(n, int), "on_target": np.ones(n, int)},
        **{"distance": np.full(n, -1.0), "overlap": np.full(n, -1.0)},
    }
    return ordinary | {name: np.asarray(values) for name, values in facts.items()}


def test_means_and_the_share_of_fixations_on_the_target():
    found = summarise(table(right=[True, False, True, True], decisions=[2, 4, 6, 8], fixations=[1, 2, 3, 4]))
    assert found == {"accuracy": 0.75, "decisions": 5.0, "fixations": 2.5, "on_target": 0.4}


def test_slopes_are_fixations_per_item_of_episodes_answered_right():
    sizes = np.repeat([1, 4, 8, 16], 4)
    absent = np.tile([False, True, False, False], 4)
    fixations = np.where(absent, 3 + 1.0 * sizes, 2 + 0.5 * sizes)
    right = np.tile([True, True, True, False], 4)
    fixations[~right] = 30
    found = summarise(table(set_size=sizes, targets=np.where(absent, 0, 1), fixations=fixations, right=right))
    assert found["slope_present"] == pytest.approx(0.5) and found["slope_absent"] == pytest.approx(1.0)
    assert found["fixations_present_8"] == 6.0 and found["fixations_absent_8"] == 11.0
    assert found["accuracy_8"] == 0.75 and found["fixations_16"] == (10 + 19 + 10 + 30) / 4
    assert "slope_absent" not in summarise(table(set_size=sizes))
    assert "accuracy_8" not in summarise(table(set_size=np.full(3, 8)))


def test_answers_here_have_a_hit_rate_a_distance_and_an_overlap():
    distance, overlap = [3.0, 5.0, -1.0, 40.0], [0.5, 0.7, -1.0, 0.0]
    found = summarise(table(right=[True, True, False, False], distance=distance, overlap=overlap))
    assert found["hit_rate"] == pytest.approx(2 / 3) and found["accuracy"] == 0.5
    assert found["distance"] == 16.0 and found["overlap"] == pytest.approx(0.4)


def test_scenes_that_only_teach_are_left_out_unless_there_are_no_others():
    taught = table(targets=[8, 1, 8, 1], right=[True, False, True, True])
    assert summarise(taught)["accuracy"] == 0.5
    assert summarise(table(targets=[8, 8], right=[True, False]))["accuracy"] == 0.5


def test_other_tasks_have_no_measures():
    assert summarise({}) == {} and summarise({"legs": np.arange(3)}) == {}
    assert summarise(table(set_size=np.zeros(0, int))) == {}


def test_a_tracker_keeps_the_last_episodes_and_those_that_are_over():
    tracker = FactsTracker(window=5)
    assert tracker.table() == {}
    for step in range(6):
        over = np.array([True, False, step % 2 == 0])
        tracker.add({"number": 10 * step + np.arange(3)}, over)
    tracker.add({"number": np.array([99])}, np.array([False]))
    kept = tracker.table()["number"].tolist()
    assert kept == [22, 30, 40, 42, 50]
    assert pooled([tracker.table(), {}, {"number": np.array([7])}])["number"].tolist() == [*kept, 7]
