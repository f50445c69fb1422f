"""Writes data as Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_BLOCK = re.compile(r"(<!-- results: [^>]*-->\n).*?(<!-- /results -->)", re.DOTALL)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Makes a table, without a newline at its end."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def fill(page: str, block: str) -> str:
    """Puts `block` between a page's marks `<!-- results: ... -->` and `<!-- /results -->`."""
    return _BLOCK.sub(lambda found: found[1] + block + found[2], page)
