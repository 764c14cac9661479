"""YAML read with the line of every key, so that each error can name file and line."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import yaml

from estimators.errors import ConfigError

Key = tuple[str | int, ...]
MAX_VALUES = 100_000
"""A twin has a few hundred values; nested aliases could otherwise ask for billions."""


class _Loader(yaml.SafeLoader):
    """YAML 1.2's plain scalars: `on` and `no` are text, 1e-3 is a number, 010 is ten."""

    yaml_implicit_resolvers: dict = {}


_TAG = "tag:yaml.org,2002:"
for _name, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9][0-9_]*|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9_]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(_TAG + _name, re.compile(f"^(?:{_pattern})$"), _first)


@dataclass
class Places:
    """Where each value stands: `file:line`, or the command-line option that gave it."""

    file: str
    lines: dict[Key, int] = field(default_factory=dict)
    options: dict[Key, str] = field(default_factory=dict)

    def at(self, key: Key) -> str:
        """The place of `key`, or of the nearest section around it that the file has."""
        for end in range(len(key), -1, -1):
            if key[:end] in self.options:
                return self.options[key[:end]]
            if key[:end] in self.lines:
                return f"{self.file}:{self.lines[key[:end]]}"
        return f"{self.file}:1"


def parse(text: str, file: str) -> tuple[Any, Places]:
    """Parse YAML.

    Args:
        text: The YAML.
        file: Its name in messages.

    Returns:
        The data, with every key as text, and the place of every value.

    Raises:
        ConfigError: In one line, if it is not YAML that a twin can be.
    """
    places = Places(file)
    try:
        node = yaml.compose(text, Loader=_Loader)
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigError(f"{file}:{line}: the character {chr(error.character)!r} is not text; remove it") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        what = (error.problem or error.context or "it cannot be read").replace("\n", " ")
        if isinstance(error, yaml.composer.ComposerError) and what == "but found another document":
            what = "a second document begins here (---)"
        raise ConfigError(f"{file}:{line}: not valid YAML: {what}; check indentation, quotes and brackets") from None
    except RecursionError:
        raise ConfigError(f"{file}:1: it is nested too deeply; a twin needs six levels") from None
    if node is None:
        return None, places
    return _Builder(places).value(node, (), ()), places


class _Builder:
    """Turns YAML nodes into plain data and notes their lines."""

    def __init__(self, places: Places) -> None:
        self.places = places
        self.count = 0

    def fail(self, node: yaml.Node, text: str) -> ConfigError:
        return ConfigError(f"{self.places.file}:{node.start_mark.line + 1}: {text}")

    def value(self, node: yaml.Node, key: Key, around: tuple[int, ...]) -> Any:
        self.count += 1
        if self.count > MAX_VALUES:
            raise self.fail(node, f"it holds more than {MAX_VALUES} values; are its aliases (*name) meant?")
        if id(node) in around:
            raise self.fail(node, "it contains itself through an alias (*name); write the value out")
        self.places.lines.setdefault(key, node.start_mark.line + 1)
        around = (*around, id(node))
        if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
            return [self.value(item, (*key, k), around) for k, item in enumerate(node.value)]
        if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
            return self.mapping(node, key, around)
        if isinstance(node, yaml.ScalarNode):
            return self.scalar(node)
        raise self.fail(node, f"the tag {node.tag} has no meaning here; remove it")

    def mapping(self, node: yaml.MappingNode, key: Key, around: tuple[int, ...]) -> dict[str, Any]:
        data: dict[str, Any] = {}
        for name, item in node.value:
            if not isinstance(name, yaml.ScalarNode):
                raise self.fail(name, "a key must be one word, not a list or mapping; put braces in quotes")
            path = (*key, name.value)
            if name.value in data:
                first = self.places.lines[path]
                raise self.fail(name, f"{dotted(path)} is given twice, first in line {first}; remove one")
            self.places.lines[path] = name.start_mark.line + 1
            data[name.value] = self.value(item, path, around)
        return data

    def scalar(self, node: yaml.ScalarNode) -> Any:
        text = node.value
        kind = node.tag.removeprefix(_TAG)
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() == "true"
        try:
            if kind == "int":
                return int(text, 16) if text.startswith("0x") else int(text)
            if kind == "float":
                return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        except ValueError:  # an integer of thousands of digits, `1_`, an explicit !!int before a word
            return text
        if kind == "str":
            return text
        raise self.fail(node, f"the tag {node.tag} has no meaning here; remove it")


def dotted(key: Key) -> str:
    """A key path as text: source.parts[1].files."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text or "the file"
