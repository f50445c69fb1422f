"""The code that the documents show runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from foajax.config.schema import Config
from foajax.config.table import page as page_of_keys

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
    assert len(BLOCKS) == 11
    assert sum(len(SAID.findall(str(block.values[0]))) for block in BLOCKS) == 17


def test_the_page_of_keys_is_what_the_schema_says():
    assert (ROOT / "docs/keys.md").read_text() == page_of_keys(Config) + "\n"


def test_links_lead_somewhere():
    own = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    pages = [*own, *ROOT.glob("*/README.md"), *ROOT.glob("results/*/README.md")]
    for page in pages:
        for link in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / link).exists(), (page.name, link)
