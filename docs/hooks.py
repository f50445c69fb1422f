"""What `make docs` adds to the pages: the page of commands, and links that end at the edge of the site."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path

from mkdocs.structure.files import File

from foajax.__main__ import COMMANDS
from foajax.config.table import tables

_LINK = re.compile(r"(?<!!)\[([^]]+)\]\(((?!https?:)[^)#]+)[^)]*\)")


def on_files(files, config):
    """Adds the page of commands, from their own words."""
    files.append(File.generated(config, "commands.md", content=_commands()))


def on_page_markdown(markdown, page, config, **_):
    """Keeps of a link to a file outside of the site its text only."""
    docs, here = Path(config.docs_dir), Path(config.docs_dir, page.file.src_uri).parent

    def shorten(link):
        return link[0] if (here / link[2]).resolve().is_relative_to(docs) else link[1]

    return _LINK.sub(shorten, markdown)


def _commands():
    lines = ["# Commands", "`foajax <command> key=value ...`; `foajax <command> --help` prints what stands here.", ""]
    for name, sentence in COMMANDS.items():
        module = importlib.import_module(f"foajax.{name}")
        lines += [f"## {name}", sentence, "", inspect.cleandoc(module.__doc__), ""]
        if name == "train":
            lines += ["Its keys are on [a page of their own](keys.md).", ""]
        else:
            lines += tables(module.Options)
    return "\n".join(lines)
