"""The site: `make docs` builds it without a warning, and each page opens in a real browser as narrow as a phone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from browser import browser, browser_needed

ROOT = Path(__file__).parent.parent
PHONE = 400  # pixels


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The pages of the site as `make docs` builds it."""
    pytest.importorskip("mkdocs", reason="the extra docs is not installed")
    directory = tmp_path_factory.mktemp("site")
    words = ["-m", "mkdocs", "build", "--strict", "--quiet", f"--site-dir={directory}"]
    built = subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return sorted(page for page in directory.rglob("*.html") if page.name != "404.html")


@browser_needed
def test_every_page_opens_on_a_phone(site):
    with browser(width=PHONE) as (page, requests):
        for file in site:
            page.goto(file.as_uri())
            assert page.evaluate("document.documentElement.scrollWidth") == PHONE, file.name
            assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)"), file
    assert len(site) >= 20 and all(url.startswith(site[0].parent.as_uri()) for url in requests)


def test_every_command_is_described(site):
    from foajax.__main__ import COMMANDS

    (commands,) = [page.read_text() for page in site if page.name == "commands.html"]
    assert all(f'<h2 id="{name}">' in commands and sentence in commands for name, sentence in COMMANDS.items())
