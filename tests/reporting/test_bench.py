"""Measurements that are kept: each says how it was made, and the table says the same."""

from __future__ import annotations

import json
import re

import pytest

from foajax.reporting import bench

FILES = sorted(bench.BENCH.glob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_measurement_says_how_it_was_made(file):
    found = json.loads(file.read_text())
    assert list(found) == ["command", "commit", "date", "machine", "results"] and found["results"]
    assert found["command"].startswith("python ") and file.name in found["command"]
    assert re.fullmatch("[0-9a-f]{7,40}", found["commit"]) and re.fullmatch(r"\d{4}-\d\d-\d\d", found["date"])
    assert found["machine"].keys() >= {"python", "packages", "cpu", "cores"} and found["machine"]["packages"]["jax"]


def test_the_table_is_what_the_files_say(tmp_path):
    for file in FILES:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    bench.write_table(tmp_path)
    assert (tmp_path / "README.md").read_text() == (bench.BENCH / "README.md").read_text()


def test_what_is_written_can_be_repeated(tmp_path):
    bench.write("out", str(tmp_path / "speed.json"), [1.5], ["python", "benchmarks/speed.py", "name=a b"])
    found = json.loads((tmp_path / "speed.json").read_text())
    assert found["results"] == [1.5] and found["command"] == "python benchmarks/speed.py 'name=a b'"
    assert found["machine"]["cores"] >= 1 and found["machine"]["packages"]["jax"]
    bench.write_table(tmp_path)
    assert "| `python benchmarks/speed.py 'name=a b'` |" in (tmp_path / "README.md").read_text()
