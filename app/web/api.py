"""The page's API: what the twin says of itself, and commands to it, as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starlette.responses import JSONResponse

from estimators.diagnostics.consistency import NisVerdict
from estimators.diagnostics.episodes import anchor, episode_json
from estimators.errors import ConfigError, nearest, printable, quoted, shown_name
from estimators.track import HEALTH_NAMES

from ..live import commands, faults
from ..live.changes import began_as, turned
from ..live.execute import PLAYBACK, Refolding, check_maintenance, check_playback, retuned
from ..live.interface import Running
from ..live.outputs import Status
from ..live.revisions import Revisions

LONGEST_NAME = 255
"""Bytes of a file's name, on nearly all file systems."""

LONGEST_LINE = 500
"""Characters of a reason, which may quote what was asked."""


class Json(JSONResponse):
    """An answer in JSON. A file's name may hold what UTF-8 cannot, so everything that is not ASCII is escaped."""

    def render(self, content: Any) -> bytes:
        """The bytes of the answer."""
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()


def one_line(text: str) -> str:
    """A reason as one line that can be shown anywhere."""
    line = printable(text).replace("\n", " ")
    return line if len(line) <= LONGEST_LINE else line[: LONGEST_LINE - 1] + "…"


def status_json(engine: Running) -> dict[str, Any]:
    """What the page's header shows, and more for whoever asks."""
    status = engine.status()
    commissioned = status.tuning.baseline is not None
    judged = NisVerdict(status.nis, status.nis_low, status.nis_high, commissioned, status.nis_judged)
    return {
        "twin": engine.twin.name,
        "title": engine.twin.title,
        "estimator": status.estimator,
        "options": _plain(dict(status.options)),
        "tuning": {key: _plain(value) for key, value, *_ in status.tuning.items()},
        "tuning_name": status.tuning.name,
        "gate": _plain(status.tuning.gate),
        "gate_kind": status.tuning.gate_kind,
        "gate_reopen": _plain(status.tuning.reopen),
        "used": {name: bool(status.tuning.get(f"use.{name}")) for name in engine.model.sensor_names},
        "began_as": began_as(engine.twin),
        "turned": _plain(turned(engine.twin, status.estimator, status.tuning)),
        "revision": status.revision,
        "refolding": status.refolding,
        "awaited": status.awaited,
        "compiling": dict(status.compiling),
        "t": status.t,
        "health": HEALTH_NAMES[status.health],
        "since": status.since,
        "cause": status.cause,
        "sensors": {name: {"state": state, "text": text} for name, (state, text) in status.sensors.items()},
        "episodes_open": status.episodes_open,
        "lost": status.lost,
        "nis": _plain(status.nis),
        "nis_low": _plain(status.nis_low),
        "nis_high": _plain(status.nis_high),
        "nis_judged": _plain(judged.measure),
        "nis_place": judged.place,
        "nis_words": judged.words,
        "late": {"inflate": engine.twin.late.inflate, "reason": engine.twin.late.reason},
        "degraded_after": {"seconds": engine.twin.degraded.seconds, "reason": engine.twin.degraded.reason},
        "model_version": status.model_version,
        "clock": None
        if status.clock is None
        else {key: _plain(value) for key, value in status.clock._asdict().items()},
        "counts": dict(status.counts),
        "account": _plain(status.account),
        "paused": status.paused,
        "finished": status.finished,
        "speed": _plain(status.speed),
        "seekable": status.seekable,
        "length": None if status.span is None else (status.span[1] - status.span[0]) * 1e-9,
        "recording": str(status.recording) if status.recording is not None else None,
        "recording_folder": None if status.recording is None else str(status.recording.absolute().parent),
        "latency_ms": _plain(status.latency_ms),
        "faults": faults.status_json(status.faults, engine.model),
        "runs": _runs(engine.revisions),
        **_integrity(status),
    }


def _runs(revisions: Revisions) -> dict[str, Any]:
    """When to ask /api/runs again (`version`), the run before the running one, those with a track, the pinned ones."""
    runs = revisions.runs
    return {
        "version": revisions.version,
        "last": runs[-2].number if len(runs) > 1 else None,
        "kept": [run.number for run in runs if run.track is not None or run is runs[-1]],
        "pinned": [
            {"number": run.number, "place": run.place, "name": run.name, "running": run is runs[-1]}
            for run in runs
            if run.pinned
        ],
    }


def episodes_json(engine: Running) -> list[dict[str, Any]]:
    """What was and is wrong, in the order of its start: times in seconds of the log, `help` in docs/alarms.md."""
    return [
        episode_json(episode) | {"help": f"docs/alarms.md#{anchor(episode.cause)}"} for episode in engine.episodes()
    ]


def faults_json(engine: Running) -> dict[str, Any]:
    """The faults that can be put into the source."""
    return faults.catalogue_json(engine.source, engine.model)


def _integrity(status: Status) -> dict[str, Any]:
    """By state the bound of its error under one unseen fault, beside 2 σ; how old that is, s; why there is none."""
    found = status.integrity
    if found is None:
        return {"integrity": {}, "integrity_age": None, "integrity_note": "not computed yet"}
    bounds = {
        name: {"bound": _plain(item.bound), "two_sigma": _plain(item.two_sigma), "unit": item.unit, "fault": item.fault}
        for name, item in found.bounds.items()
    }
    return {"integrity": bounds, "integrity_age": found.age(status.t), "integrity_note": found.reason}


def _plain(value: Any) -> Any:
    """JSON has no infinity and no NaN."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, (bool, str, int)):
        return value
    number = float(value)
    return number if math.isfinite(number) else str(number) if math.isinf(number) else None


def command_from_json(body: Any, engine: Running) -> commands.Command:
    """The command that `{"command": NAME, field: value, ...}` stands for; infinity is written "inf".

    Raises:
        NisusError: If there is no such command, a field is missing, unknown or of another kind, or the engine would
            refuse it: better said to who asked than shown later as an event.
    """
    known = {kind.__name__: kind for kind in typing.get_args(commands.Command)}
    if not isinstance(body, dict):
        raise ConfigError(f'the body is {_shown(body)}; it must be like {{"command": "Reset"}}')
    if "command" not in body:
        raise ConfigError(f"command is missing; {nearest('', known)}")
    name = body["command"]
    if not isinstance(name, str) or name not in known:
        raise ConfigError(f"command is {_shown(name)}; {nearest(name if isinstance(name, str) else '', known)}")
    kind = known[name]
    hints = typing.get_type_hints(kind)
    given = {key: value for key, value in body.items() if key != "command"}
    fields = {item.name: item for item in dataclasses.fields(kind)}
    for field in given:
        if field not in fields:
            remedy = nearest(field, fields) if fields else "it takes no field"
            raise ConfigError(f"{name}: {shown_name(field)} is not known; {remedy}")
    for field, item in fields.items():
        if field not in given and item.default is dataclasses.MISSING:
            raise ConfigError(f"{name}: {field} is missing; it takes {', '.join(fields)}")
    command = kind(**{field: _converted(name, field, given[field], hints[field]) for field in given})
    if isinstance(command, commands.Record) and command.path is not None and engine.recorder is not None:
        command = dataclasses.replace(command, path=_placed(command.path, engine.recorder.folder))
    _check(command, engine)
    return command


def _check(command: commands.Command, engine: Running) -> None:
    if isinstance(command, Refolding):
        retuned(command, engine)
    elif isinstance(command, commands.Pin):
        engine.revisions.free_place(command.number)
    elif isinstance(command, commands.Unpin):
        engine.revisions.find(command.number)
    elif isinstance(command, commands.Note):
        engine.revisions.check_words(command.number, command.name, command.note)
    elif isinstance(command, commands.Reset) and not engine.span()[1]:
        raise ConfigError("Reset: nothing to reset; no reading has come yet")
    elif isinstance(command, commands.Maintenance):
        check_maintenance(command.what, command.states, engine.model)
        if not engine.span()[1]:
            raise ConfigError("Maintenance: no reading has come yet; what is believed is what was at first")
    elif isinstance(command, commands.Record) and engine.recorder is None:
        raise ConfigError("Record: this session cannot record")
    elif isinstance(command, commands.InjectFault | commands.ClearFault):
        faults.check_fault(command, engine.source, engine.model)
    if isinstance(command, PLAYBACK):
        check_playback(command)
        if not engine.status().seekable:
            raise ConfigError("a live source cannot be paused, stepped or sought; only a replay or a simulation can")


def _recording(where: str, name: str) -> Path:
    # A bare name: a browser says what the file is called, not where on the disk it goes, nor what it replaces.
    path = Path(name)
    if path.suffix != ".rrd" or name != path.name or "\\" in name or name.startswith("."):
        raise ConfigError(f"{where}; it must be a file name that ends in .rrd, without folders")
    if not name.isprintable():
        raise ConfigError(f"{where}; it must have letters that can be shown, no control characters or half ones")
    if len(os.fsencode(name)) > LONGEST_NAME:
        raise ConfigError(f"{where}, which is too long; it may have {LONGEST_NAME} bytes")
    return path


def _placed(name: Path, folder: Path) -> Path:
    """Where a recording of that name goes."""
    if os.path.lexists(folder / name):
        raise ConfigError(f"Record: path is {_shown(str(name))}, which is there already; choose another name")
    return folder / name


def _converted(command: str, name: str, value: Any, hint: Any) -> Any:
    allowed = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for kind in allowed:
        if kind is type(None) and value is None:
            return None
        if kind in (bool, str) and isinstance(value, kind):
            return value
        if kind is int and isinstance(value, int) and not isinstance(value, bool):
            if abs(value) >= 2**53:
                raise ConfigError(f"{command}: {name} is too large; it must be below 2^53")
            return value
        if typing.get_origin(kind) is tuple and isinstance(value, list) and all(isinstance(v, str) for v in value):
            return tuple(value)
        if typing.get_origin(kind) is Mapping and isinstance(value, dict):
            return {key: _converted(command, f"{name}.{shown_name(key)}", value[key], float) for key in value}
        if kind is float and not isinstance(value, bool) and (isinstance(value, (int, float)) or value == "inf"):
            try:
                number = float(value)
            except OverflowError:
                raise ConfigError(f"{command}: {name} is too large; it must be a finite number") from None
            if not math.isnan(number):
                return number
        if kind is Path and isinstance(value, str):
            return _recording(f"{command}: {name} is {_shown(value)}", value)
    wanted = " or ".join({"float": "a number", "int": "a whole number", "bool": "true or false", "NoneType": "null",
                          "str": "a text", "Path": "a path", "tuple": "a list of texts",
                          "Mapping": "an object of numbers"}[kind.__name__]
                         for kind in allowed)  # fmt: skip
    raise ConfigError(f"{command}: {name} is {_shown(value)}; it must be {wanted}")


def _shown(value: Any) -> str:
    """A value of the request as an answer shows it: as JSON has it, shortened."""
    return quoted(value) if isinstance(value, str) else shown_name(json.dumps(value))
