"""YAML read with the line of every key, so that each error can name file and line."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from estimators.errors import ConfigError

TWINS = Path(__file__).resolve().parent / "twins"  # Folder of the twins that ship

Key = tuple[str | int, ...]
MERGE = "<<"  # Key whose value is a mapping, or a list of these, with defaults for the keys beside it
MAX_VALUES = 100_000  # A twin has a few hundred values; nested aliases could otherwise ask for billions


def rounded(value: Any, digits: int = 4) -> Any:
    """Return a float, or a list or mapping of them, to so many significant digits; anything else as it is."""
    if isinstance(value, dict):
        return {key: rounded(item, digits) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item, digits) for item in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


class _Loader(yaml.SafeLoader):
    """YAML 1.2's plain scalars: `on` and `no` are text, 1e-3 is a number, 010 is ten."""

    yaml_implicit_resolvers: dict = {}


class _QuickLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The same by libyaml, where PyYAML has it: a tenth of the time."""

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
    for _loader in (_Loader, _QuickLoader):
        _loader.add_implicit_resolver(_TAG + _name, re.compile(f"^(?:{_pattern})$"), _first)


def shipped() -> list[str]:
    """Return the names of the bundled twins."""
    return sorted(path.stem for path in yaml_files(TWINS))


BASELINE = ".baseline.yaml"  # End of the name of a file beside a twin's: NAME.baseline.yaml


def baseline_file(path: Path) -> Path:
    """Return the file with the baseline of the twin in another file."""
    return path.with_name(f"{path.stem}{BASELINE}")


def yaml_files(folder: Path) -> list[Path]:
    """Return the YAML files of a folder but those of baselines, by name."""
    found = (path for path in folder.glob("*") if path.suffix in (".yaml", ".yml") and path.is_file())
    return sorted(path for path in found if not path.name.endswith(BASELINE))


@dataclass
class ValuePlaces:
    """Place of each value: `file:line`, or the command-line option that gave it."""

    file: str
    lines: dict[Key, int] = field(default_factory=dict)
    options: dict[Key, str] = field(default_factory=dict)
    older: list[str] = field(default_factory=list)
    """Names of the version before, in words; see `old_names`."""
    by_hand: bool = False
    """Whether its text cannot be rewritten by the names of this version."""

    def at(self, key: Key) -> str:
        """Return the place of `key`, or of the nearest section around it that the file has."""
        for end in range(len(key), -1, -1):
            if key[:end] in self.options:
                return self.options[key[:end]]
            if key[:end] in self.lines:
                return f"{self.file}:{self.lines[key[:end]]}"
        return f"{self.file}:1"

    def give(self, key: Key, option: str) -> None:
        """Note the option that gave the value at `key` and everything in it, in place of the file."""
        for known in (self.lines, self.options):
            for inner in [inner for inner in known if inner[: len(key)] == key]:
                del known[inner]
        self.options[key] = option


def parse(text: str, file: str) -> tuple[Any, ValuePlaces]:
    """Parse YAML; return the data, with every key as text, and the place of every value. Messages name `file`.

    Raises:
        ConfigError: In one line, if it is not YAML that a twin can be.
    """
    places = ValuePlaces(file)
    try:
        node = composed(text)
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


def composed(text: str) -> yaml.Node | None:
    """Return the nodes of a YAML text; of a wrong one, PyYAML describes the error better than libyaml."""
    with suppress(yaml.YAMLError):
        return yaml.compose(text, Loader=_QuickLoader)
    return yaml.compose(text, Loader=_Loader)


class _Builder:
    """Turns YAML nodes into plain data and notes their lines."""

    def __init__(self, places: ValuePlaces) -> None:
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

    def mapping(self, node: yaml.MappingNode, key: Key, around: tuple[int, ...]) -> dict[str, object]:
        data: dict[str, object] = {}
        merged: dict[str, object] = {}
        for name, item in node.value:
            if name.value == MERGE and not name.style:
                for part in item.value if isinstance(item, yaml.SequenceNode) else (item,):
                    if not isinstance(part, yaml.MappingNode):
                        raise self.fail(name, f"{dotted(key)}.{MERGE} must name mappings, as in {MERGE}: *name")
                    merged = {**self.value(part, key, around), **merged}
                continue
            if not isinstance(name, yaml.ScalarNode):
                raise self.fail(name, "a key must be one word, not a list or mapping; put braces in quotes")
            path = (*key, name.value)
            if name.value in data:
                first = self.places.lines[path]
                raise self.fail(name, f"{dotted(path)} is given twice, first in line {first}; remove one")
            self.places.lines[path] = name.start_mark.line + 1
            data[name.value] = self.value(item, path, around)
        return {**merged, **data}

    def scalar(self, node: yaml.ScalarNode) -> object:
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
    """Return a key path as text: source.parts[1].files."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text or "the file"


PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
RESERVED = {"null", "true", "false"}


def as_section(name: str, items: Mapping[str, object]) -> list[str]:
    """Return a section as lines, an entry each; none if it is empty."""
    return [f"{name}:", *(f"  {_key(key)}: {as_flow(value)}" for key, value in items.items())] if items else []


def _key(name: str) -> str:
    return name if PLAIN.fullmatch(name) and name.lower() not in RESERVED else json.dumps(name, ensure_ascii=False)


def as_flow(value: object) -> str:
    """Return a value in one line of YAML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)}: {as_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(as_flow, value)) + "]"
    if isinstance(value, str):
        return _key(value)
    if isinstance(value, float) and value == round(value) and abs(value) < 1e15:
        return str(int(value))
    return json.dumps(value)


def shown_path(path: Path) -> str:
    """Return a path as messages show it: relative to the working directory where it lies inside."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def read_text(path: Path, listing: str) -> str:
    """Return the text of a YAML file; `listing` is the command that lists them.

    Raises:
        ConfigError: If it is not there, no file, or no text.
    """
    shown_name = shown_path(path)
    try:
        if not path.is_file() and not path.is_dir() and path.exists():
            raise ConfigError(f"{shown_name}: it is a pipe or a device, which may never end; give a file")
        raw = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{shown_name}: there is no such file; check the path, or see `{listing}`") from None
    except IsADirectoryError:
        raise ConfigError(f"{shown_name}: it is a folder; give the YAML file in it") from None
    except OSError as error:
        raise ConfigError(f"{shown_name}: it cannot be read: {error.strerror}; check its permissions") from None
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if path.suffix.lower() == ".rrd":
            raise ConfigError(f"{shown_name}: it is a recording; `nisus review {shown_name}` opens it") from None
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{shown_name}:{line}: it is not UTF-8 text; is this the YAML file?") from None


@contextmanager
def writing(path: Path, option: str = "") -> Iterator[None]:
    """Report an error while a file is written in one line that names it, with the command line's `option` for it.

    Raises:
        ConfigError: In place of any OSError; most of those name no file (a full disk).
    """
    try:
        yield
    except OSError as error:
        name = f"{option} {shown_path(path)}".strip()
        raise ConfigError(
            f"{name}: cannot be written: {error.strerror or error}; check free space and permissions"
        ) from None


def with_section(text: str, key: str, section: str) -> str:
    """Return a YAML text in which the section `key` has these lines; without one, they are appended."""
    # The key and the lines under it, to the last that is indented; a comment after that belongs to what follows.
    pattern = re.compile(
        rf"^{re.escape(key)}[ \t]*:.*(?:\n|\Z)(?:(?:[ \t]*(?:#.*)?\n)*[ \t]+[^\s#].*(?:\n|\Z))*", re.MULTILINE
    )
    kept, found = pattern.subn(lambda _: section, text, count=1)
    return kept if found else text.rstrip("\n") + "\n\n" + section


def with_values(text: str, values: Mapping[Key, object]) -> tuple[str, list[Key]]:
    """Return a YAML text with other values at some keys, and the keys that it does not have; comments stay.

    A value that an alias shares with another key counts as one that it does not have. A mapping replaces any value, and
    is the first entry of its section where that has no such key.
    """
    root = composed(text)
    places = Counter(map(id, _nodes(root)))
    edits: list[tuple[int, int, str]] = []
    missing: list[Key] = []
    for key, value in values.items():
        node, shared = root, False
        name: Any = None
        for part in key:
            section, head, name = node, name, None
            if isinstance(node, yaml.SequenceNode) and isinstance(part, int):
                node = node.value[part]
            else:
                items = node.value if isinstance(node, yaml.MappingNode) else ()
                name, node = next((item for item in items if item[0].value == part), (None, None))
            shared |= places[id(node)] > 1
        written = as_flow(value)
        if shared:
            missing.append(key)
        elif isinstance(value, Mapping) and name is not None:
            edits.append((name.end_mark.index, end_of(node), f": {written}"))
        elif isinstance(value, Mapping) and isinstance(section, yaml.MappingNode) and section.value and head:
            first, line = section.value[0][0].start_mark, f"{_key(str(part))}: {written}"
            if section.flow_style:
                edits.append((first.index, first.index, f"{line}, "))
            else:  # above the comments on the first entry
                begin = text.index("\n", head.end_mark.index) + 1
                edits.append((begin, begin, " " * first.column + line + "\n"))
        elif isinstance(node, yaml.SequenceNode if isinstance(value, list) else yaml.ScalarNode):
            edits.append((node.start_mark.index, node.end_mark.index, written))
        else:
            missing.append(key)
    for begin, end, written in sorted(edits, reverse=True):
        text = text[:begin] + written + text[end:]
    return text, missing


def end_of(node: Any) -> int:
    """Return the index after a node; PyYAML ends one in block style after the comments that follow."""
    while isinstance(node, yaml.CollectionNode) and not node.flow_style:
        node = node.value[-1][1] if isinstance(node, yaml.MappingNode) else node.value[-1]
    return int(node.end_mark.index)


def _nodes(node: yaml.Node | None) -> Iterator[yaml.Node | None]:
    """Return a node and those below it; that of an alias at each of its places."""
    yield node
    if isinstance(node, yaml.CollectionNode):
        for item in node.value:
            for part in item if isinstance(item, tuple) else (item,):
                yield from _nodes(part)
