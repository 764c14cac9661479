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
from .yaml_files import MERGE, Key, ValuePlaces, composed, dotted, end_of, parse, shown_path, writing

ANY = None
BY_HAND = "rewrite it by hand, as parts of it are shared or stand in two places"
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
    found: dict[str, str] = {}
    for key, text in overrides.items():
        way = new_key(tuple(key.split(".")))
        if way[0] == "estimate":
            if len(way) != 3:
                raise ConfigError(f"--set {key}={text}: give its entries, as in --set parameters.NAME.std=0.1")
            way = ("parameters", *way[1:])
            found.setdefault(dotted((*way[:2], "role")), "estimated")
        if tell and key != dotted(way):
            _tell(f"--set {key}: it is {dotted(way)} now")
        if dotted(way) in found:
            raise ConfigError(f"--set {key}={text}: {dotted(way)} is given twice; remove one")
        found[dotted(way)] = rewritten(text, way)
    return found


def read_yaml(text: str, file: str) -> tuple[str, Any, ValuePlaces]:
    """Return a YAML text by the names of this version, its data, and the place of every value; see `parse`.

    `places.older` has what was rewritten, in words.
    """
    data, places = parse(text, file)
    lines = places.lines
    old = [key for key in lines if _is_old(key)]
    named = {key[-1]: (lines[key], new_key(key)[-1]) for key in old}
    older = [f"{name} (line {line}) is {new} now" for name, (line, new) in named.items() if name != new]
    if len(named) > len(older):
        older.append("an interval is [low, high] now")
    if ("estimate",) in lines:
        older.append("estimate is `role: estimated` of an entry of parameters now")
    for key in old:
        if (new := new_key(key)) != key and new in lines:
            rule = f"is {new[-1]} now, which stands in line {lines[new]}; keep one"
            raise ConfigError(f"{file}:{lines[key]}: {dotted(key)} {rule}")
    if older:
        text, data = rewritten(text), _joined(renamed(data), places)
        places.lines |= {new_key(key): line for key, line in lines.items()}
        left = parse(text, file)[1].lines
        places.older, places.by_hand = older, ("estimate",) in left or any(map(_is_old, left))
    return text, data, places


def renamed(value: Any, key: Key = ()) -> Any:
    """Return the data at `key` by the names and notations of this version."""
    if isinstance(value, list):
        return [renamed(item, (*key, k)) for k, item in enumerate(value)]
    if not isinstance(value, dict):
        return value
    ways = {name: _way(key, name, isinstance(item, dict)) for name, item in value.items()}
    return _interval(value, key) or {str(ways[name][-1]): renamed(item, ways[name]) for name, item in value.items()}


def rewritten(text: str, key: Key = ()) -> str:
    """Return the text of the value at `key`, or of a file, by the names and notations of this version.

    Text stays as it is if it is no YAML, or if the data would be others: an alias or `<<` may share what is renamed.
    """
    with suppress(ConfigError):
        data, places = parse(text, "")
        new = _edited(text, dict(_edits(composed(text), key, text)))
        if _joined(parse(new, "")[0], places) == _joined(renamed(data, key), places):
            return new
    return text


def _joined(data: Any, places: ValuePlaces) -> Any:
    """Return the data with the entries of `estimate`, a section of the version before, in those of `parameters`."""
    if not isinstance(data, dict) or "estimate" not in data:
        return data
    parameters = data.get("parameters") or {}
    if not isinstance(data["estimate"] or {}, dict) or not isinstance(parameters, dict):
        return data
    for name, entry in (data["estimate"] or {}).items():
        own = parameters.get(name)
        own = own if isinstance(own, dict) else {} if own is None else {"value": own}
        at = places.at(("estimate", name))
        if not isinstance(entry, dict):
            raise ConfigError(
                f"{at}: estimate.{name} must be a mapping; write parameters.{name} with `role: estimated`"
            )
        if twice := [word for word in own if word in entry or word == "role"]:
            raise ConfigError(f"{at}: estimate.{name} and parameters.{name} both give {twice[0]}; keep one")
        parameters = {**parameters, name: {**own, **entry, "role": "estimated"}}
    places.lines |= {("parameters", *key[1:]): line for key, line in places.lines.items() if key[:1] == ("estimate",)}
    return {name: item for name, item in data.items() if name != "estimate"} | {"parameters": parameters}


def tell_older(places: ValuePlaces) -> None:
    """Say which older names a file has."""
    if places.older:
        way = BY_HAND if places.by_hand else f"`nisus migrate {places.file}` rewrites it"
        _tell(f"{places.file}: {', '.join(places.older)}; {way}")


def rewrite(path: Path, change: Callable[[str], str], out: Path | None = None) -> Path | None:
    """Write the changed text of a YAML file, by the names of this version, to `out`, or over itself.

    Returns:
        The copy of the file as it was, beside it; None where `out` was written.

    Raises:
        ConfigError: If it cannot be written, or has older names that cannot be rewritten.
    """
    with writing(out or path):
        with path.open(encoding="utf-8-sig", newline="") as file:
            text = file.read()
        end = "\r\n" if "\r\n" in text else "\n"
        new, _, places = read_yaml(text.replace("\r\n", "\n"), shown_path(path))
        if places.by_hand:
            raise ConfigError(f"{places.file}: {', '.join(places.older)}; {BY_HAND}")
        changed = change(new).replace("\n", end)
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
    interval = _interval({name: text[item.start_mark.index : end_of(item)] for name, item in entries.items()}, key)
    if interval is not None:
        begin, end, between = node.start_mark.index, end_of(node), ""
        anchor = "".join(re.findall(r"\A&\S+\s+", text[begin:end]))
        for name, item in node.value:
            between += text[begin : name.start_mark.index]
            begin = end_of(item)
        # Comments stay, and ends of lines, so that the lines below keep their numbers.
        left = re.findall(r"[ \t]*#.*|\n", between + text[begin:end])
        yield node.start_mark.index, (end, anchor.replace("\n", " ") + _flow(interval) + "".join(left))
        return
    for name, item in node.value:
        if name.value == MERGE and not name.style:
            for part in item.value if isinstance(item, yaml.SequenceNode) else (item,):
                yield from _edits(part, key, text)
            continue
        if (*key, name.value) == ("estimate",) and "parameters" not in entries and isinstance(item, yaml.MappingNode):
            yield name.start_mark.index, (name.end_mark.index, "parameters")
            for own in (own for _, own in item.value if isinstance(own, yaml.MappingNode)):
                end = end_of(own) - own.flow_style
                yield (
                    end,
                    (end, ", role: estimated" if own.flow_style else f"\n{'':{own.start_mark.column}}role: estimated"),
                )
            continue
        new = _way(key, name.value, isinstance(item, yaml.MappingNode))
        if new[-1] != name.value:
            yield name.start_mark.index, (name.end_mark.index, str(new[-1]))
        yield from _edits(item, new, text)


def _way(key: Key, name: str, mapping: bool) -> Key:
    """Return the new key of an entry; `learned` with a mapping is the head of a correction's own file."""
    new = new_key((*key, name))
    return (*key, name) if new == ("correction",) and mapping else new


def _interval(given: dict[str, Any], key: Key) -> list[Any] | dict[str, Any] | None:
    """Return a mapping of data or texts that is an interval of before in the notation of now; None if it is none."""
    if _like(key, INTERVALS) and {"min", "max"} & set(given) and set(given) <= {"min", "max", "extrapolate"}:
        pair = [given.get("min"), given.get("max")]
        return {"range": pair, "extrapolate": given["extrapolate"]} if "extrapolate" in given else pair
    if _like(key, BOUNDED) and {"from", "to"} & set(given) and set(given) <= {"value", "from", "to"}:
        return {"value": given.get("value"), "range": [given.get("from"), given.get("to")]}
    return None


def _flow(value: Any) -> str:
    """Return an interval of texts as YAML."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name}: {_flow(item)}' for name, item in value.items())}}}"
    return f"[{', '.join(map(_flow, value))}]" if isinstance(value, list) else value or "null"
