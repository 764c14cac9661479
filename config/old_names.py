"""Names and notations of the version before: they are read for one version, and `nisus migrate` rewrites them.

The text is rewritten, so that the schema and everything behind it know one name; lines and comments stay.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import yaml

from estimators.errors import ConfigError

from .extensions import warn
from .yaml_files import MERGE, Key, ValuePlaces, composed, dotted, end_of, parse, writing

ANY = None
_tell = cache(warn)

CHANNELS = [("source", group, ANY) for group in ("sensors", "inputs", "truth")]

RENAMED: dict[tuple[str | None, ...], str] = {
    ("learned",): "correction",
    ("valid",): "valid_range",
    ("commissioned",): "baseline",
    ("time", "horizon"): "max_delay",
    ("time", "tick"): "predict_every",
    ("view", "at"): "cursor",
    ("sensors", ANY, "at"): "landmarks",
    ("parameters", ANY, "use"): "role",
    **{(group, ANY, kind, "use"): "role" for group in ("sensors", "inputs") for kind in ("offset", "scale")},
    ("sensors", ANY, "error", "over"): "correlation_time",
    ("noise", ANY, "over"): "correlation_time",
    **{(*channel, "where"): "valid_if" for channel in CHANNELS},
    **{(*channel, "by"): "landmark_column" for channel in CHANNELS},
}
"""New names by old key; the names of the sections around it are the new ones, and ANY is any name."""

INTERVALS = [
    ("valid_range", ANY),
    ("possible", ANY),
    *((*channel, key, ANY) for channel in CHANNELS for key in ("valid_if", "only")),
    *((*channel, "landmark_column", ANY, ANY) for channel in CHANNELS),
]
"""Keys whose value was {min, max} and is [low, high]."""

BOUNDED = [
    *((group, ANY, key) for group in ("noise", "sensors") for key in ("std", "variance")),
    *(("source", "sensors", ANY, key) for key in ("std", "variance")),
]
"""Keys whose value was {value, from, to} and is {value, range: [low, high]}."""


def _like(key: Key, patterns: Collection[tuple[str | None, ...]]) -> tuple[str | None, ...] | None:
    """Return the pattern that a key has; a part of a source, and its asset, are like a source."""
    while key[:1] == ("source",) and key[1:2] in (("parts",), ("asset",)):
        key = ("source", *key[3 if key[1] == "parts" else 2 :])
    fits = (len(key) == len(way) and all(b in (ANY, a) for a, b in zip(key, way)) for way in patterns)
    return next((way for way, fit in zip(patterns, fits) if fit), None)


def new_key(key: Key) -> Key:
    """Return a key by the names of this version."""
    found: Key = ()
    for part in key:
        way = _like((*found, part), RENAMED)
        found = (*found, part if way is None else RENAMED[way])
    return found


def new_overrides(overrides: Mapping[str, str], *, tell: bool = False) -> dict[str, str]:
    """Return the values of `--set` by the names and notations of this version; older ones are told with `tell`."""
    ways = {key: new_key(tuple(key.split("."))) for key in overrides}
    for key, way in ways.items():
        if tell and key != dotted(way):
            _tell(f"--set {key}: it is {dotted(way)} now")
    return {dotted(ways[key]): rewritten(text, ways[key]) for key, text in overrides.items()}


def read_yaml(text: str, file: str) -> tuple[str, Any, ValuePlaces]:
    """Return a YAML text by the names of this version, its data, and the place of every value; see `parse`.

    `places.older` has what was rewritten, in words.
    """
    data, places = parse(text, file)
    lines = places.lines
    named = {key[-1]: (line, new_key(key)[-1]) for key, line in lines.items() if _is_old(key)}
    older = [f"{old} (line {line}) is {new} now" for old, (line, new) in named.items() if old != new]
    if len(named) > len(older):
        older.append("an interval is [low, high] now")
    if ("estimate",) in lines:
        hand = ", move its entries there by hand" if ("parameters",) in lines else ""
        older.append(f"estimate is `role: estimated` of an entry of parameters now{hand}")
    if older:
        text = rewritten(text)
        data, places = parse(text, file)
        places.older = older
    return text, data, places


def rewritten(text: str, key: Key = ()) -> str:
    """Return the text of the value at `key`, or of a file, by the names and notations of this version.

    Text that is no YAML stays as it is.
    """
    with suppress(ConfigError):
        parse(text, "")
        return _edited(text, dict(_edits(composed(text), key, text)))
    return text


def joined(data: dict[str, Any], places: ValuePlaces) -> None:
    """Move the entries of `estimate`, a section of the version before, to those of `parameters`."""
    given = data.get("estimate")
    if not isinstance(given, dict) or not isinstance(data.get("parameters") or {}, dict):
        return
    del data["estimate"]
    parameters = data["parameters"] = dict(data.get("parameters") or {})
    for name, entry in given.items():
        own = parameters.get(name)
        own = own if isinstance(own, dict) else {} if own is None else {"value": own}
        parameters[name] = {**own, **entry, "role": "estimated"} if isinstance(entry, dict) else entry
    known: Any
    for known in (places.lines, places.options):
        known |= {("parameters", *key[1:]): known[key] for key in known if key[:1] == ("estimate",)}


def tell_older(places: ValuePlaces) -> None:
    """Say which older names a file has."""
    if places.older:
        _tell(f"{places.file}: {', '.join(places.older)}; `nisus migrate {places.file}` rewrites it")


def rewrite(path: Path, change: Callable[[str], str], out: Path | None = None) -> Path | None:
    """Write the changed text of a YAML file, by the names of this version, to `out`, or over itself.

    Returns:
        The copy of the file as it was, beside it; None where `out` was written.

    Raises:
        ConfigError: If it cannot be written.
    """
    with writing(out or path):
        with path.open(encoding="utf-8-sig", newline="") as file:
            text = file.read()
        end = "\r\n" if "\r\n" in text else "\n"
        changed = change(rewritten(text.replace("\r\n", "\n"))).replace("\n", end)
        kept = None
        if out is None:
            numbers = (path.with_name(f"{path.name}.{k}.bak") for k in count(1))
            kept = next(copy for copy in numbers if not copy.exists())
            shutil.copy2(path, kept)
        (out or path).write_text(changed, encoding="utf-8", newline="")
    return kept


WORDS = {way[-1] for way in RENAMED} | {"min", "max", "from", "to"}


def _is_old(key: Key) -> bool:
    if not key or key[-1] not in WORDS:
        return False
    if key[-1:] in (("min",), ("max",)):
        return _like(new_key(key[:-1]), INTERVALS) is not None
    if key[-1:] in (("from",), ("to",)):
        return _like(key[:-1], BOUNDED) is not None
    return new_key(key) != key


def _edited(text: str, edits: dict[int, tuple[int, str]]) -> str:
    for begin, (end, new) in sorted(edits.items(), reverse=True):
        text = text[:begin] + new + text[end:]
    return text


def _edits(node: yaml.Node | None, key: Key, text: str) -> Iterator[tuple[int, tuple[int, str]]]:
    """Yield the spans that have new text, as (begin, (end, text)); `key` has new names."""
    if isinstance(node, yaml.SequenceNode):
        for k, item in enumerate(node.value):
            yield from _edits(item, (*key, k), text)
    if not isinstance(node, yaml.MappingNode):
        return
    entries = {name.value: item for name, item in node.value}
    interval = _interval(entries, key, text)
    if interval is not None:
        begin, end, between = node.start_mark.index, end_of(node), ""
        for name, item in node.value:
            between += text[begin : name.start_mark.index]
            begin = end_of(item)
        # Comments stay, and ends of lines, so that the lines below keep their numbers.
        left = re.findall(r"[ \t]*#.*|\n", between + text[begin:end])
        yield node.start_mark.index, (end, interval + "".join(left))
        return
    for name, item in node.value:
        if name.value == MERGE and not name.style:
            for part in item.value if isinstance(item, yaml.SequenceNode) else (item,):
                yield from _edits(part, key, text)
            continue
        if (*key, name.value) == ("estimate",) and "parameters" not in entries and isinstance(item, yaml.MappingNode):
            yield name.start_mark.index, (name.end_mark.index, "parameters")
            for _, own in item.value:
                end = end_of(own) - own.flow_style
                yield (
                    end,
                    (end, ", role: estimated" if own.flow_style else f"\n{'':{own.start_mark.column}}role: estimated"),
                )
            continue
        new = new_key((*key, name.value))
        if new[-1] != name.value and (new != ("correction",) or isinstance(item, yaml.ScalarNode)):
            yield name.start_mark.index, (name.end_mark.index, str(new[-1]))
        yield from _edits(item, new, text)


def _interval(entries: dict[str, yaml.Node], key: Key, text: str) -> str | None:
    """Return a mapping that is an interval of before in the notation of now; None if it is none."""
    given = {name: text[item.start_mark.index : end_of(item)] for name, item in entries.items()}
    if _like(key, INTERVALS) and {"min", "max"} & set(given) and set(given) <= {"min", "max", "extrapolate"}:
        pair = f"[{given.get('min', 'null')}, {given.get('max', 'null')}]"
        return f"{{range: {pair}, extrapolate: {given['extrapolate']}}}" if "extrapolate" in given else pair
    if _like(key, BOUNDED) and {"from", "to"} & set(given) and set(given) <= {"value", "from", "to"}:
        return f"{{value: {given.get('value')}, range: [{given.get('from', 'null')}, {given.get('to', 'null')}]}}"
    return None
