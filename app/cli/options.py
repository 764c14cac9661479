"""Values of options: `--set KEY=VALUE`, lists of names, numbers, and files to write."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

import tyro

from estimators.errors import ConfigError, nearest, quoted

if TYPE_CHECKING:
    from estimators.log import Events

    from ..study.advice.plan import Roles
    from .arguments import PartOptions, RoleOptions


def check_output(option: str, path: Path, *endings: str, new: str = "") -> None:
    """Refuse a file that cannot be written, before minutes of work; with the remedy `new`, one that exists.

    Raises:
        ConfigError: If it has none of the endings, is a folder, or its folder is missing or not writable.
    """
    if endings and path.suffix not in endings:
        raise ConfigError(f"{option} {path}: must end in {endings[0]}")
    folder = path.absolute().parent
    if path.is_dir():
        raise ConfigError(f"{option} {path}: is a folder; name a file in it")
    if not folder.is_dir():
        raise ConfigError(f"{option} {path}: there is no folder {path.parent}; create it first")
    if new and os.path.lexists(path):
        raise ConfigError(f"{option} {path}: there is such a file; {new}")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ConfigError(f"{option} {path}: cannot be written; check the permissions")


def names_of(text: str) -> tuple[str, ...]:
    """Return names that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def roles_of(options: RoleOptions) -> Roles:
    """Return the roles of signals that options give."""
    from ..study.advice.plan import Roles

    return Roles(*map(names_of, (options.sensors, options.inputs, options.hold_out, options.signals)))


def overrides_of(arguments: Any) -> dict[str, str]:
    """Return the KEY=VALUE pairs of `--set`, with `--estimator` and `--tuning`, where given, as two more.

    Raises:
        ConfigError: If one has no `=`, or no key before it.
    """
    pairs: dict[str, str] = {}
    for text in arguments.set:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            lacks = "key" if equals else "value"
            raise ConfigError(f"--set {text}: has no {lacks}; write KEY=VALUE, for example --set R.winding=9")
        pairs[key.strip()] = value.strip()
    named = {name: getattr(arguments, name, None) for name in ("estimator", "tuning")}
    return pairs | {name: value for name, value in named.items() if value is not None}


def seconds_of(option: str, text: str) -> float:
    """Return the seconds of an option, given as a number or with a unit: 600, 10min.

    Raises:
        ConfigError: If it is neither, or not positive.
    """
    from pydantic_core import PydanticCustomError

    from config.fields import as_seconds

    try:
        value = as_seconds(text)
    except PydanticCustomError:
        try:
            value = float(text)
        except ValueError:
            raise ConfigError(f"{option} {text}: give seconds, or a number with its unit, as in 10min") from None
    if not 0.0 < value < float("inf"):
        raise ConfigError(f"{option} {text}: must be positive")
    return float(value)


def span_of(options: PartOptions, events: Events) -> tuple[int, int] | None:
    """Return begin and end, ns, of the part of a log that `--since` and `--until` select; None for all.

    Raises:
        ConfigError: If one is no time, or no measurement lies between them.
    """
    from estimators.log import READING

    from ..format_time import format_time

    if options.since is None and options.until is None:
        return None
    begin = int(events.t[0]) if options.since is None else moment_of("--since", options.since, events)
    end = int(events.t[-1]) + 1 if options.until is None else moment_of("--until", options.until, events)
    if not ((events.kind == READING) & (events.t >= begin) & (events.t < end)).any():
        given = " ".join(
            f"{name} {text}" for name, text in (("--since", options.since), ("--until", options.until)) if text
        )
        raise ConfigError(
            f"{given}: there is no measurement in this part; the log is from {format_time(int(events.t[0]))} to "
            f"{format_time(int(events.t[-1]))}"
        )
    return begin, end


def moment_of(option: str, text: str, events: Events) -> int:
    """Return a moment of a log, ns: a share of the measurements, a time after the start, or a date."""
    from datetime import UTC, datetime

    import numpy as np

    from estimators.log import READING

    from ..format_time import FIRST_DATED_NS

    share, percent, _ = text.rpartition("%")
    if percent:
        try:
            return int(np.quantile(events.t[events.kind == READING], float(share) / 100.0))
        except ValueError:
            raise ConfigError(f"{option} {text}: give a share from 0% to 100%") from None
    try:
        when = datetime.fromisoformat(text) if "-" in text[1:] and "e-" not in text else None
    except ValueError:
        raise ConfigError(f"{option} {text}: is no date; write for example 2024-05-01T14:00 (UTC)") from None
    if when is None:
        try:
            return int(events.t[0]) + (0 if text in ("0", "0s") else round(seconds_of(option, text) * 1e9))
        except ConfigError:
            rule = "give a share (50%), a time after the start (600, 10min) or a date (2024-05-01T14:00)"
            raise ConfigError(f"{option} {text}: {rule}") from None
    if events.t[0] < FIRST_DATED_NS:
        raise ConfigError(f"{option} {text}: the times of this log have no date; give seconds after its start")
    return round((when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()) * 10**9


def options_of(command: type) -> dict[str, object]:
    """Return the types of a command's options, by field; positional arguments are left out."""
    hints = get_type_hints(command, include_extras=True)
    hints = {field.name: hints[field.name] for field in dataclasses.fields(command)}
    return {name: kind for name, kind in hints.items() if tyro.conf.Positional not in getattr(kind, "__metadata__", ())}


def check_options(name: str, command: type, words: Sequence[str]) -> None:
    """Refuse an option that a command does not have, or whose value must be a number and is not, in one line.

    Raises:
        ConfigError: With the option, its value and the nearest option.
    """
    known = {f"--{field.replace('_', '-')}": hint for field, hint in options_of(command).items()}
    seen: set[str] = set()
    for word, after in zip(words, [*words[1:], ""], strict=False):
        option, equals, own = word.partition("=")
        if not option.startswith("--") or option == "--help":
            continue
        name_of = option.replace("_", "-")
        hint = known.get(name_of)
        if hint is None:
            raise ConfigError(f"{quoted(option)}: `nisus {name}` has no such option; {nearest(option, known)}")
        if name_of in seen and get_origin(hint) is tuple:  # a repeatable option is Annotated
            raise ConfigError(f"{option}: is given twice, of which only the last would count; name all after the first")
        seen.add(name_of)
        value = own if equals else after
        number = next((kind for kind in (hint, *get_args(hint)) if kind in (int, float)), None)
        if number is None or value in ("", "None") or value.startswith("--"):
            continue
        try:
            number(value)
        except ValueError:
            kind = "a whole number" if number is int else "a number"
            raise ConfigError(f"{option} {quoted(value)}: must be {kind}") from None


FLAG_ON, FLAG_OFF = ("1", "true", "yes", "on"), ("0", "false", "no", "off")


def environment_options(name: str, command: type, arguments: Sequence[str], variables: Mapping[str, str]) -> list[str]:
    """Return the options of a command that environment variables give and the arguments do not.

    For --port of `nisus run` that is NISUS_RUN_PORT. A list is separated by blanks; a flag is on for 1, true, yes
    or on.

    Raises:
        ConfigError: If there is no such option, or a flag has another value than these or their opposites.
    """
    hints = options_of(command)
    given = {argument.partition("=")[0].replace("_", "-") for argument in arguments}
    begin = f"NISUS_{name.upper()}_"
    found: list[str] = []
    for variable in sorted(each for each in variables if each.startswith(begin)):
        field, value = variable.removeprefix(begin).lower(), variables[variable].strip()
        if field not in hints:
            near = nearest(variable, [f"{begin}{each.upper()}" for each in hints])
            raise ConfigError(f"{variable}: there is no such option; {near}")
        option, marks = f"--{field.replace('_', '-')}", getattr(hints[field], "__metadata__", ())
        if option in given or not value:
            continue
        if tyro.conf.FlagCreatePairsOff in marks:
            if value.lower() not in (*FLAG_ON, *FLAG_OFF):
                raise ConfigError(f"{variable} is {quoted(value)}; it must be {', '.join((*FLAG_ON, *FLAG_OFF))}")
            found += [option] * (value.lower() in FLAG_ON)
        elif tyro.conf.UseAppendAction in marks:
            found += [part for each in value.split() for part in (option, each)]
        else:
            found += [option, *(value.split() if get_origin(hints[field]) is tuple else [value])]
    return found
