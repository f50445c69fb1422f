"""`import foajax`, and `foajax <command>`."""

from __future__ import annotations

import ast
import importlib
import runpy
import sys
from pathlib import Path

import pytest

import foajax
from foajax.__main__ import COMMANDS, main
from foajax.config.table import groups

PACKAGE = Path(foajax.__file__).parent


@pytest.mark.parametrize("name", foajax.__all__)
def test_a_public_name_is_found_on_first_use(name):
    assert getattr(foajax, name).__name__ == name


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="foajax.*nothing"):
        foajax.nothing  # noqa: B018


@pytest.mark.parametrize("name", sorted(COMMANDS.keys() - {"train"}))
def test_every_option_of_a_command_has_a_sentence(name):
    options = importlib.import_module(f"foajax.{name}").Options
    assert all(key.sentence[0].isupper() and key.sentence[-1] == "." for group in groups(options) for key in group.keys)


def test_every_command_is_listed_with_a_sentence(monkeypatch, capsys):
    run = {f.stem for f in PACKAGE.glob("*.py") if '__name__ == "__main__"' in f.read_text()} - {"__main__"}
    assert run == set(COMMANDS)
    monkeypatch.setattr(sys, "argv", ["foajax"])
    main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[2:]] == list(COMMANDS)
    assert all(sentence.endswith(".") and len(sentence) < 80 for sentence in COMMANDS.values())
    for command in COMMANDS:
        first = ast.get_docstring(ast.parse((PACKAGE / f"{command}.py").read_text())).splitlines()[0]
        assert first[0].isupper() and f": `foajax {command}" in first


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")  # these processes would not have
@pytest.mark.parametrize("words", [["status", "--help"], ["store", "--help"], ["status", "nowhere"], ["train", "game"]])
def test_both_spellings_are_one_command(monkeypatch, capsys, words):
    monkeypatch.setattr(sys, "path", [*sys.path])
    results = []
    for module, arguments in (("foajax", words), (f"foajax.{words[0]}", words[1:])):
        monkeypatch.setattr(sys, "argv", ["foajax", *arguments])
        with pytest.raises(SystemExit) as ended:  # as by `python -m`
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        results.append((ended.value.code, *capsys.readouterr()))
    first, second = results
    assert first == second and (first[1] or first[2].startswith("foajax: error: "))


def test_a_command_that_is_not_there_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["foajax", "trian"])
    with pytest.raises(SystemExit, match="2"):
        main()
    said = f"foajax: error: trian: did you mean train? accepted is one of {', '.join(COMMANDS)}\n"
    assert capsys.readouterr().err == said
