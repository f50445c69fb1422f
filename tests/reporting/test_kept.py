"""The kept runs can be repeated: their commands, in the words of today's defaults, compose to what they were."""

from __future__ import annotations

import shlex

import pytest

from foajax.config.compose import compose
from foajax.config.parse import flatten, to_mapping
from foajax.reporting import kept
from foajax.runs.directory import FREE, load_config


@pytest.mark.parametrize("path", [path for path in sorted(kept.KEPT.iterdir()) if path.is_dir()], ids=lambda p: p.name)
def test_the_listed_command_makes_a_kept_run(path):
    command = kept.command_today(path)
    assert command in (kept.KEPT / "README.md").read_text().splitlines()
    words = shlex.split(command.removeprefix("python -m foajax.train "))
    asked, made = (dict(flatten(to_mapping(config))) for config in (compose(words), load_config(path)))
    assert {key for key in asked | made if asked.get(key) != made.get(key)} <= FREE
