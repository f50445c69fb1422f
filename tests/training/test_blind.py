"""A policy that grows sure without looking is told from one that learns; the numbers are of runs on Breakout."""

import math

import pytest

from foajax.training.journal import is_blind


@pytest.mark.parametrize(
    ("entropy", "information", "blind"),
    [
        (1.386, 0.0001, False),  # nothing learned yet
        (1.30, 0.005, False),  # hardly surer than chance
        (1.05, 0.02, True),  # the plateau at 2.1 points
        (1.21, 0.12, False),  # learning, at 0.15 million env_steps
        (0.77, 0.34, False),  # learning, at 0.5 million
    ],
)
def test_what_is_blind(entropy, information, blind):
    assert is_blind({"natural_entropy": entropy, "natural_information": information}, 4) == blind


def test_a_uniform_policy_of_any_game_is_not_blind():
    for actions in (2, 6, 18):
        assert not is_blind({"natural_entropy": math.log(actions), "natural_information": 0.0}, actions)
