"""The kept runs can be repeated: their commands, in the words of today's defaults, compose to what they were."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from pathlib import Path

import pytest

from foajax.config.compose import compose
from foajax.config.parse import flatten, to_mapping
from foajax.runs.directory import FREE, load_config

SCRIPT = Path(__file__).parents[1] / "results" / "keep.py"
spec = importlib.util.spec_from_file_location("keep", SCRIPT)
keep = importlib.util.module_from_spec(spec)
sys.modules["keep"] = keep  # where dataclasses look up their annotations
spec.loader.exec_module(keep)


@pytest.mark.parametrize("path", [path for path in sorted(keep.KEPT.iterdir()) if path.is_dir()], ids=lambda p: p.name)
def test_the_listed_command_makes_a_kept_run(path):
    command = keep.command_today(path)
    assert command in (keep.KEPT / "README.md").read_text().splitlines()
    words = shlex.split(command.removeprefix("python -m foajax.train "))
    asked, made = (dict(flatten(to_mapping(config))) for config in (compose(words), load_config(path)))
    assert {key for key in asked | made if asked.get(key) != made.get(key)} <= FREE
