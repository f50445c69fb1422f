"""A real browser for the tests of pages: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import contextlib
import shutil

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
browser_needed = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)"
)


@contextlib.contextmanager
def browser(width=1366, height=768):
    """An empty page in a new browser, and the list of what it asks for. Ends with an error if a page complained."""
    from playwright.sync_api import sync_playwright

    complaints, requests = [], []
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = chromium.new_page(viewport={"width": width, "height": height})
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        yield page, requests
        chromium.close()
    assert complaints == []


@contextlib.contextmanager
def opened_page(file):
    """A page in a new browser. Ends with an error if the page complained or asked for anything else."""
    with browser() as (page, requests):
        page.goto(file.as_uri())
        yield page
    assert [url for url in requests if not url.startswith(("data:", "blob:"))] == [file.as_uri()]
