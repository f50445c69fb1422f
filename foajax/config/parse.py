"""Sections of keys: frozen pydantic models, whose errors are one line with the key, its value and what is accepted.

The keys are in `foajax.config.schema`.
"""

from __future__ import annotations

import difflib
import functools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator, model_validator

ABSENT: Any = object()  # no value
CODE = "package.module:Class"  # how a part of the user's is named


class ConfigError(ValueError):
    """Something that the user has to correct. The message is one line: what was given, and what is accepted."""


def refuse(
    key: str,
    value: object = ABSENT,
    accepted: str | Iterable[str] = "key=value",
    *,
    why: str = "",
    near: str | None = None,
    kind: type[ConfigError] = ConfigError,
) -> ConfigError:
    """Makes the error about a key's value, or about a word by itself. The caller raises it.

    `accepted` is a phrase or all choices. Of choices it suggests the one nearest to the value, or to `near`. `why` says
    what is wrong where that is not plain.
    """
    given = key if value is ABSENT else f"{key}={brief(value)}"
    if not isinstance(accepted, str):
        choices = tuple(accepted)
        found = difflib.get_close_matches(str(value) if near is None else near, choices, n=1)
        why = suggest(why, *found)
        accepted = f"one of {', '.join(choices)}"
    between = " " if why.endswith("?") else "; "
    return kind(f"{given}: " + between.join(filter(None, [why, accepted and f"accepted is {accepted}"])))


def suggest(why: str, *names: str) -> str:
    """Adds to `why` the first of the names that the user may have meant."""
    if not names:
        return why
    return f"{why} (did you mean {names[0]}?)" if why else f"did you mean {names[0]}?"


def one_line(*parts: object) -> str:
    """Joins words, or the lines of an error, into one line."""
    return " ".join(" ".join(map(str, parts)).split())


def file_name(text: str) -> str:
    """Replaces characters that are unusual in a file's name by hyphens."""
    return "".join(c if c.isalnum() or c in "_-." else "-" for c in text)


def brief(value: object) -> str:
    """Formats a value for a message: one line of at most 200 characters, with YAML's null, true and false."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    plain = to_mapping(value)
    text = one_line(plain) or repr(plain)
    return text if len(text) <= 200 else text[:197] + "..."


class Frozen(dict):
    """A mapping that cannot change, and so can be hashed."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple:
        return type(self), (dict(self),)

    def _fixed(self, *_: Any, **__: Any) -> Any:
        raise TypeError("a configuration is frozen; foajax.config.parse.replace makes another")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = setdefault = update = _fixed


def _frozen(value: Any) -> Any:
    """Turns lists into tuples and dicts into `Frozen`, so that the value can be hashed."""
    if isinstance(value, (list, tuple)):
        return tuple(map(_frozen, value))
    return Frozen({key: _frozen(each) for key, each in value.items()}) if type(value) is dict else value


class Section(BaseModel):
    """A group of keys, each with a type, bounds, a default and a sentence.

    It is frozen and can be hashed. Types are exact: a bool is no int, a string no number. But an int may stand for a
    float, and a list for a tuple. A float has to fit into float32.

    Raises:
      ConfigError: an unknown or a missing key, or a value of another type or out of range.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True)
    prefix: ClassVar[str] = ""  # of the keys' names, where a section is made by itself

    def __init__(self, /, *values: Any, **named: Any) -> None:
        if len(values) > len(type(self).model_fields):
            raise TypeError(f"{type(self).__name__} has {len(type(self).model_fields)} keys, not {len(values)}")
        named = dict(zip(type(self).model_fields, values, strict=False), **named)
        try:
            super().__init__(**named)
        except ValidationError as error:
            raise _refused(error, type(self), named) from None

    # So pydantic makes inner sections without it, and their mistakes reach the outermost, which knows the whole names.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{type(self).__name__}.{name}: is frozen; foajax.config.parse.replace makes another")

    def check(self) -> None:
        """Raises `ConfigError` where keys contradict each other. It names a key without the section."""

    @model_validator(mode="after")
    def _check(self) -> Any:
        self.check()
        return self

    @field_validator("*", mode="wrap")
    @classmethod
    def _exact(cls, value: Any, handler: Any) -> Any:
        found = _frozen(handler(_frozen(value)))
        if isinstance(found, float) and found != 0 and not 1e-37 <= abs(found) <= 1e38:
            raise ValueError(", in the range of float32 (1e-37 to 1e38)")
        if isinstance(found, int) and isinstance(value, float):
            raise ValueError  # 5.0 is equal to a choice of 5
        return found


SectionT = TypeVar("SectionT", bound=Section)


def build(cls: type[SectionT], mapping: Any, key: str = "config") -> SectionT:
    """Makes a section from nested mappings, such as YAML gives."""
    if not isinstance(mapping, Mapping):
        raise refuse(key, mapping, "a mapping")
    return cls(**{str(name): value for name, value in mapping.items()})


def replace(section: SectionT, **changes: Any) -> SectionT:
    """Makes a checked copy of a section with other values for some keys."""
    return type(section)(**{**dict(section), **changes})


def to_mapping(value: Any) -> Any:
    """Converts a section, or a value in one, to plain dicts, lists and scalars."""
    if isinstance(value, (Section, Mapping)):
        return {key: to_mapping(each) for key, each in dict(value).items()}
    return [to_mapping(each) for each in value] if isinstance(value, (list, tuple)) else value


def flatten(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields each dotted key with its value."""
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


@functools.cache
def schema_of(cls: type[Section]) -> dict[str, Any]:
    """The JSON schema of a section."""
    return cls.model_json_schema()


def resolve(node: Mapping[str, Any], root: Mapping[str, Any]) -> dict[str, Any]:
    """Merges a node of a JSON schema with the definition that it refers to."""
    reference = node.get("$ref", "").rpartition("/")[2]
    return {**root["$defs"][reference], **node} if reference else dict(node)


def kinds(node: Mapping[str, Any], root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Returns the sections that a key may hold, by their `kind`; empty for a key without kinds."""
    sections = (resolve(each, root) for each in node.get("oneOf", ()))
    return {each["properties"]["kind"].get("const", CODE): each for each in sections}


def describe(node: Mapping[str, Any]) -> str:
    """Says in words what a node of a JSON schema accepts."""
    if "accepted" in node:
        return node["accepted"]
    if "anyOf" in node:
        return " or ".join(map(describe, node["anyOf"]))
    if "enum" in node or "const" in node:
        return "one of " + ", ".join(map(str, node.get("enum", [node.get("const")])))
    match node.get("type"):
        case "array" if "prefixItems" in node:
            return f"[{', '.join(map(describe, node['prefixItems']))}]"
        case "array":
            several = re.sub(r"^an? (integer|number|string)\b", r"\1s", describe(node.get("items", {})))
            return f"a list of {'one or more ' if node.get('minItems') else ''}{several}"
        case "object" if isinstance(node.get("additionalProperties"), Mapping) and "properties" not in node:
            return f"a mapping to {describe(node['additionalProperties'])}"
        case "integer" | "number" as kind:
            return _describe_number(node, is_integer=kind == "integer")
    words = {"boolean": "true or false", "string": "a string", "null": "null"}
    return words.get(node.get("type", ""), "a mapping")


def _describe_number(node: Mapping[str, Any], *, is_integer: bool) -> str:
    if "multipleOf" in node:
        return f"a multiple of {node['multipleOf']}"
    name = "an integer" if is_integer else "a number"
    least, above = node.get("minimum"), node.get("exclusiveMinimum")
    most, below = node.get("maximum"), node.get("exclusiveMaximum")
    if least is above is most is below is None:
        return name
    ends = (above if least is None else least, below if most is None else most)
    low, high = (str(end) if is_integer or end is None else f"{end:g}" for end in ends)
    if most is below is None:
        return f"{name} >{'' if least is None else '='} {low}"
    if is_integer:
        return f"{name} from {low} to {high}"
    return f"{name} in {'(' if least is None else '['}{low}, {high}{')' if most is None else ']'}"


def _refused(error: ValidationError, cls: type[Section], data: Mapping[str, Any]) -> ConfigError:
    """Makes our error of the first mistake that pydantic found. Unknown keys come before other mistakes."""
    first = min(error.errors(include_url=False), key=lambda each: each["type"] != "extra_forbidden")
    root = schema_of(cls)
    keys, value, node, around = _find(first["loc"], data, root)
    prefix = cls.prefix + "".join(f"{key}." for key in keys)
    name = prefix[:-1] or "config"
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, ConfigError):
        return ConfigError(f"{prefix}{cause}")
    if first["type"] == "extra_forbidden":
        known = around["properties"]
        why = suggest("unknown key", *_nearest(str(keys[-1]), prefix.removesuffix(f"{keys[-1]}."), known, root))
        return refuse(name, value, f"one of {', '.join(known)}" if known else "", why=why)
    if value is ABSENT:
        return refuse(name, accepted=with_sentence(describe(node), node.get("description", "")), why="missing")
    if first["type"] == "union_tag_invalid":
        return refuse(f"{name}.kind", value.get("kind"), kinds(node, root))
    return refuse(name, value, f"{describe(node)}{cause or ''}")


def with_sentence(accepted: str, sentence: str) -> str:
    """Adds a key's sentence to what it accepts, for the error about a missing key."""
    return f"{accepted}: {sentence[:1].lower()}{sentence[1:].removesuffix('.')}" if sentence else accepted


def _nearest(word: str, prefix: str, known: Iterable[str], root: Mapping[str, Any]) -> list[str]:
    """Finds the key that a misspelt word may mean: a similar one of its section, or a very similar one elsewhere."""
    places = {name: f"{prefix}{name}" for name in known}
    elsewhere = {dotted.rpartition(".")[2]: dotted for dotted in reversed(list(_dotted(root, root)))}
    for name in difflib.get_close_matches(word, {**elsewhere, **places}):
        if name in places:
            return [places[name]]
        if difflib.get_close_matches(word, [name], cutoff=0.8):
            return [elsewhere[name]]
    return []


def _dotted(node: Mapping[str, Any], root: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yields the dotted keys of a schema, without those that depend on a `kind`."""
    for word, child in node.get("properties", {}).items():
        child = resolve(child, root)
        if "properties" in child:
            yield from _dotted(child, root, f"{prefix}{word}.")
        else:
            yield f"{prefix}{word}"


def _find(
    place: Sequence[int | str], value: Any, root: dict[str, Any]
) -> tuple[list[str], Any, dict[str, Any], dict[str, Any]]:
    """Follows pydantic's path to a mistake: the keys on the way, the value there, its schema, and its section's."""
    keys: list[str] = []
    node = around = root
    for part in place[:-2] if place and place[-1] == "[key]" else place:
        if "oneOf" in node:
            node = kinds(node, root)[str(part)]
            continue
        if "properties" in node:
            around, node = node, resolve(node["properties"].get(part, {}), root)
        elif isinstance(node.get("additionalProperties"), dict):
            node = node["additionalProperties"]
        else:
            break
        keys.append(str(part))
        value = value.get(part, ABSENT)
    return keys, value, node, around
