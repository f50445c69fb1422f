"""The doctor: its table, and what it says where a package is missing or of another version."""

from __future__ import annotations

import importlib.metadata
import tomllib
from pathlib import Path

import pytest

from foajax import cli, doctor

NEEDED = {
    "foajax": ["numpy>=2", "jax[fast]>=0.1", "filming>=1; extra == 'video'"],
    "jax": ["speed>=3; extra == 'fast'", "slowness; extra == 'slow'"],
}


@pytest.fixture
def needed(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: NEEDED.get(name))


def installed(monkeypatch, **versions):
    monkeypatch.setattr(doctor, "version", versions.get)


def words(capsys):
    return " ".join(capsys.readouterr().out.split())


def test_what_is_there_is_said(needed, monkeypatch, capsys):
    installed(monkeypatch, foajax="1.0", numpy="2.1", jax="0.2", speed="3.0")
    assert cli.run(doctor.doctor, []) == 0
    said = words(capsys)
    assert "missing nothing devices cpu" in said and "jax 0.2" in said and "GB free" in said
    assert "extra video writes videos as mp4" in said and "pip install 'foajax[video]' would add filming" in said


def test_a_missing_and_an_old_package_are_named(needed, monkeypatch, capsys):
    installed(monkeypatch, foajax="1.0", numpy="1.9", jax="0.2")
    assert cli.run(doctor.doctor, []) == 1
    assert "missing numpy>=2 (1.9 is installed), speed devices" in words(capsys)


def test_a_checkout_that_is_not_installed_is_said(monkeypatch, capsys):
    installed(monkeypatch)
    assert cli.run(doctor.doctor, []) == 1
    assert "missing foajax devices" in words(capsys)


def test_it_takes_no_words(capsys):
    assert cli.run(doctor.doctor, ["game=pong"]) == 2
    assert capsys.readouterr().err == "foajax: error: game=pong: unknown key\n"
    assert cli.run(doctor.doctor, ["--verbose"]) == 2
    assert capsys.readouterr().err == "foajax: error: --verbose: the command takes no words\n"


def test_every_extra_is_described():
    project = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
    assert doctor.EXTRAS.keys() == project["optional-dependencies"].keys()
