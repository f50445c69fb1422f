"""Markdown that is written from data."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_BLOCK = re.compile(r"(<!-- results: [^>]*-->\n).*?(<!-- /results -->)", re.DOTALL)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table, without a line's end at its end."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def fill(page: str, block: str) -> str:
    """A page with `block` between its marks `<!-- results: ... -->` and `<!-- /results -->`."""
    return _BLOCK.sub(lambda found: found[1] + block + found[2], page)
