"""Lists every key with its default, what it accepts and its sentence: for Hydra, `--help` and docs/keys.md.

`python -m foajax.config.table > docs/keys.md` makes the page anew.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from foajax.config.parse import ABSENT, Section, describe, kinds, resolve, schema_of

_PAGE = """# Keys

Every key of a run, with its default. The experiment sets what is *required*: `constant70` if you name none. Set a key
on the command line: `foajax train gaze.step=8`.

A choice of a group, such as `learner=paper` or `experiment=seek`, sets several keys at once. `foajax train --help`
lists the choices; `foajax train experiment=seek --cfg job` prints the values of all keys.

`python -m foajax.config.table > docs/keys.md` makes this page from `foajax/config/schema.py`.

## The run"""


class Key(NamedTuple):
    """A key as help shows it."""

    name: str  # dotted
    default: Any  # ABSENT where it has to be given
    accepted: str
    sentence: str

    @property
    def word(self) -> str:
        """The key with its default, as it is typed."""
        plain = self.default if isinstance(self.default, str) else None
        return f"{self.name}={'required' if self.default is ABSENT else plain or json.dumps(self.default)}"


class Group(NamedTuple):
    """The keys of one section."""

    name: str  # dotted; empty for the outermost
    kind: str  # of the sensor, where its keys depend on that; else empty
    sentence: str
    keys: list[Key]


def groups(cls: type[Section]) -> Iterator[Group]:
    """Yields the keys of a section and of the sections inside it, in order."""
    root = schema_of(cls)
    return _groups(root, root)


def _groups(node: Mapping[str, Any], root: Mapping[str, Any], name: str = "", kind: str = "") -> Iterator[Group]:
    keys, inner = [], []
    for word, child in node["properties"].items():
        child, dotted = resolve(child, root), f"{name}.{word}".removeprefix(".")
        if several := kinds(child, root):
            inner += [(each, root, dotted, which) for which, each in several.items()]
        elif "properties" in child:
            inner.append((child, root, dotted, ""))
        else:
            default = node.get("default", {}).get(word, child.get("default", ABSENT))
            if "follows" in node:
                default = f"${{{node['follows']}.{word}}}"
            keys.append(Key(dotted, default, describe(child), child.get("description", "")))
    yield Group(name, kind, node.get("description", "").partition("\n\n")[0], keys)
    for arguments in inner:
        yield from _groups(*arguments)


def defaults(cls: type[Section]) -> dict[str, Any]:
    """Returns the defaults nested, as Hydra has them: `???` for a required key; none for keys that depend on a kind."""
    found: dict[str, Any] = {}
    for group in groups(cls):
        section = found
        for name in group.name.split(".") if group.name and not group.kind else ():
            section = section.setdefault(name, {})
        for key in group.keys if not group.kind else ():
            section[key.name.rpartition(".")[2]] = "???" if key.default is ABSENT else key.default
    return found


def listed(cls: type[Section]) -> str:
    """Formats the keys for a terminal, one per line."""
    lines = []
    for group in groups(cls):
        if group.name:
            lines.append(f"{group.name}{group.kind and f', kind={group.kind}'}: {group.sentence}")
        lines += [f"  {key.word}  {key.sentence} Accepted: {key.accepted}." for key in group.keys]
    return "\n".join(lines)


def page(cls: type[Section]) -> str:
    """Formats the keys as a page in Markdown."""
    return "\n".join([_PAGE, *tables(cls)]).rstrip()


def tables(cls: type[Section]) -> list[str]:
    """Formats a heading and a table for each section, as lines of Markdown."""
    lines = []
    for group in groups(cls):
        if group.name:
            lines.append(f"## {group.name}{group.kind and f', kind={group.kind}'}")
        lines += [group.sentence, "", "| key | accepted | meaning |", "|---|---|---|"]
        for key in group.keys:
            cells = map(_cell, (f"`{key.word}`", key.accepted, key.sentence))
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return lines


def _cell(text: str) -> str:
    return text.replace("|", "\\|") if "`" in text else text.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    from foajax.config.schema import Config

    print(page(Config))
