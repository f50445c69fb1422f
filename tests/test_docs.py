"""The code that the documents show runs as it stands there."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest
from PIL import Image

from foajax import cli
from foajax.config.schema import Config
from foajax.config.table import page as page_of_keys
from foajax.launch import sweep

ROOT = Path(__file__).parent.parent
BLOCKS = [
    pytest.param(block, id=f"{page}-{i}")
    for page in ("README.md", "docs/embedding.md", "docs/extending.md")
    for i, block in enumerate(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL))
]
SAID = re.compile(r"^(\S.*)  # ((?:Dict)?[(\[].*)$", re.MULTILINE)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("block", BLOCKS)
def test_a_block_of_code_runs_and_gives_what_it_says(block, monkeypatch):
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(block, names)
    for expression, value in SAID.findall(block):
        assert str(eval(expression, names)) in (value, f"({value})")


def test_there_are_blocks_and_values():
    assert len(BLOCKS) == 12
    assert sum(len(SAID.findall(str(block.values[0]))) for block in BLOCKS) == 17


def commands():
    """Every command line of the guide, without its comment."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for language, block in re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            if language not in ("", "sh"):
                continue
            for line in block.replace("\\\n", " ").splitlines():
                found = re.match(r"(?:foajax |python -m foajax\.)([a-z]+)(?: ([^#]*))?", line)
                if found and not re.search(r"\.\.\.|<", line):
                    yield page.name, found[1], shlex.split(found[2] or "")


@pytest.mark.parametrize(("page", "command", "words"), list(commands()))
def test_a_command_has_the_keys_that_a_page_gives_it(page, command, words):
    if command == "train":
        words = [word for word in words if word[0] != "-" and not word.startswith("hydra")]
        assert sweep.expand(words)
        return
    module = importlib.import_module(f"foajax.{command}")
    words = [word for word in words if "=" in word and not word.startswith(("env.", "search.", "sensor."))]
    assert cli.parse(module.Options, words)


def test_the_moving_picture_is_small():
    assert (ROOT / "docs/breakout.gif").stat().st_size < 3e6
    with Image.open(ROOT / "docs/breakout.gif") as picture:
        assert picture.n_frames >= 200


def test_the_page_of_keys_is_what_the_schema_says():
    assert (ROOT / "docs/keys.md").read_text() == page_of_keys(Config) + "\n"


def test_promises_name_tests_that_exist():
    tests = {file.name: file.read_text() for file in (ROOT / "tests").rglob("test_*.py")}
    named = re.findall(r"(test_\w+\.py)::(test_\w+)", (ROOT / "docs/reliability.md").read_text())
    assert len(named) > 40 and all(f"def {name}(" in tests[file] for file, name in named)


def test_links_lead_somewhere():
    own = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    pages = [*own, *ROOT.glob("*/README.md"), *ROOT.glob("results/*/README.md")]
    for page in pages:
        for link in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / link).exists(), (page.name, link)
