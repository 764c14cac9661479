"""Check YAML against a schema; report errors of pydantic as `file:line: key is value; rule`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from estimators.errors import ConfigError, nearest

from .extensions import left_out
from .old_names import read_yaml
from .output_schema import ReceiverSection
from .source_schema import PartSection, SourceSection
from .yaml_files import Key, ValuePlaces, dotted, shown_path

MAX_PROBLEMS = 5  # Problems shown at once
MAX_SHOWN_ITEMS = 40  # Characters up to which a list or mapping is shown in full
MAX_LISTED_WORDS = 8  # Choices up to which all are listed; of more, the nearest ones


def shown(value: object) -> str:
    """Return a value as an error shows it."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        text = ", ".join(f"{key}: {shown(item)}" for key, item in value.items())
        return f"{{{text}}}" if 0 < len(text) <= MAX_SHOWN_ITEMS else "a mapping"
    if isinstance(value, (list, tuple)):
        text = ", ".join(shown(item) for item in value)
        return f"[{text}]" if len(text) <= MAX_SHOWN_ITEMS else f"a list of {len(value)}"
    if isinstance(value, str):
        value = value if len(value) <= 60 else value[:57] + "..."
        return repr(value)
    return str(value) if len(str(value)) <= 60 else str(value)[:57] + "..."


S = TypeVar("S", bound=BaseModel)


def check_section(kind: type[S], text: str, path: Path, rule: str) -> tuple[S, dict[str, object], ValuePlaces]:
    """Check YAML against a schema; return the section, the data, and the place of each value.

    `rule` ends the error text if the file is no mapping.

    Raises:
        ConfigError: With a line for each of the first problems.
    """
    file = shown_path(path)
    _, data, places = read_yaml(text, file)
    if not isinstance(data, dict):
        raise ConfigError(f"{file}:1: the file is {shown(data)}; {rule}")
    try:
        return kind.model_validate(data), data, places
    except ValidationError as error:
        raise report(error, data, places) from None


def report(error: ValidationError, data: object, places: ValuePlaces) -> ConfigError:
    """Return one ConfigError with a line for each of the first problems."""
    found: dict[tuple, str] = {}  # One line a key: pydantic repeats itself for each kind that a value might have been.
    problems = error.errors(include_url=False)
    located = [_locate(problem["loc"], data) for problem in problems]
    for problem, (key, value) in zip(problems, located, strict=True):
        entries = isinstance(value, list) and any(other[: len(key)] == key != other for other, _ in located)
        if entries or (problem["type"] == "too_short" and value != [] and len(problems) > 1):
            continue  # Its entries are there and have problems of their own.
        place = (key, problem["loc"][-1] if problem["type"] == "missing" else None)
        found.setdefault(place, _line(problem, key, value, places))
    lines = list(found.values())
    more = len(lines) - MAX_PROBLEMS
    if more > 0:
        lines[MAX_PROBLEMS:] = [f"{places.file}: and {more} more"]
    return ConfigError("\n".join(lines))


def _line(problem: ErrorDetails, key: Key, value: object, places: ValuePlaces) -> str:
    kind, context = problem["type"], problem.get("ctx", {})
    if kind == "missing":
        name = problem["loc"][-1]
        if isinstance(name, int):
            return f"{places.at(key)}: {dotted(key)} is {shown(value)}; it needs {name + 1} or more entries"
        return f"{places.at(key)}: {dotted((*key, name))} is missing; add it"
    if kind == "unknown_key":
        stray = (*key, context["key"])
        rule = nearest(context["key"], context["known"]) + (left_out() if key == ("outputs",) else "")
        return f"{places.at(stray)}: {dotted(stray)} is not known; {rule}"
    if kind == "relation":
        key = (*key, context["key"])
        return f"{places.at(key)}: {dotted(key)} {problem['msg']}"
    if kind == "both":
        return f"{places.at((*key, context['key']))}: {dotted(key)} {problem['msg']}; keep one"
    if kind == "absent":
        return f"{places.at(key)}: {dotted(key)} {problem['msg']}; add it"
    if kind == "no_kind":
        return f"{places.at(key)}: {dotted(key)} {problem['msg']}{left_out() or '; add it'}"
    if kind == "union_tag_not_found":
        return f"{places.at(key)}: {dotted((*key, 'type'))} is missing; {_choices(problem)}"
    if kind == "union_tag_invalid":
        key, value = (*key, "type"), context["tag"]
        rule = nearest(context["tag"], [item.strip("'") for item in context["expected_tags"].split(", ")]) + left_out()
    else:
        rule = _rule(kind, context, problem["msg"], value)
    return f"{places.at(key)}: {dotted(key)} is {shown(value)}; {rule}"


def _locate(loc: tuple[str | int, ...], data: object) -> tuple[Key, object]:
    """Return the part of a pydantic location that exists in the YAML, without union members and lone list items."""
    key: list[str | int] = []
    for part in loc:
        if isinstance(data, dict) and part in data:
            data = data[str(part)]
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            data = data[part]
        else:
            continue
        key.append(part)
    return tuple(key), data


def _choices(problem: ErrorDetails) -> str:
    unions: dict[Key, object] = {("source",): SourceSection, ("outputs", "receivers"): ReceiverSection}
    sections = get_args(unions.get(problem["loc"][:2], PartSection))[0]
    kinds = [get_args(section.model_fields["type"].annotation)[0] for section in get_args(sections) or (sections,)]
    return f"it must be one of {', '.join(kinds)}"


_RULES = {
    "float": "it must be a number",
    "int": "it must be a whole number",
    "bool": "it must be true or false",
    "string": "it must be text; put it in quotes if it looks like a number",
    "dict": "it must be a mapping of keys and values",
    "model": "it must be a mapping of keys and values",
    "tuple": "it must be a list",
    "list": "it must be a list",
    "finite": "it must be a finite number",
    "less_than_equal": "it must be {le:g} at most",
    "less_than": "it must be below {lt:g}",
    "too_short": "it needs {min_length} or more entries",
    "too_long": "it may have {max_length} entries at most",
    "string_too_long": "it may have {max_length} characters at most",
    "string_too_short": "it must not be empty",
    "string_pattern_mismatch": "use letters, digits, _ and -, and begin with a letter or digit",
}
"""Rules by pydantic's type of error, or its first word; braces are filled from the context of the error."""

_PATTERNS = {
    "^(https?": "give an address such as https://HOST/PATH, or $NAME, the environment variable that holds it",
    "^opc": "give an address such as opc.tcp://HOST:4840",
    r"^[^\s/]": "give a host name or an IP address, without spaces and slashes",
    "^[^+#": "leave out the characters + and #",
    "^[^+/#": "leave out the characters +, / and #",
    "^[A-Za-z_]": "use letters, digits and _, and begin with a letter or _",
}
"""Rules by the beginning of the pattern that a text breaks."""


def _rule(kind: str, context: dict[str, Any], text: str, value: object) -> str:
    if kind == "greater_than":
        return "it must be positive" if context["gt"] == 0 else f"it must be above {context['gt']:g}"
    if kind == "greater_than_equal":
        return "it must be zero or positive" if context["ge"] == 0 else f"it must be {context['ge']:g} or more"
    if kind == "literal_error":
        words = re.findall(r"'([^']*)'", context["expected"])
        return nearest(str(value), words) if len(words) > MAX_LISTED_WORDS else f"it must be {context['expected']}"
    if kind == "string_pattern_mismatch":
        found = (text for begin, text in _PATTERNS.items() if context["pattern"].startswith(begin))
        return next(found, _RULES[kind])
    rule = _RULES.get(kind) or _RULES.get(kind.split("_")[0])
    return text[:1].lower() + text[1:] if rule is None else rule.format(**context)
