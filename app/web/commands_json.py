"""Commands to a running twin, as JSON."""

from __future__ import annotations

import dataclasses
import os
import typing
from pathlib import Path

from pydantic import TypeAdapter

from estimators.errors import ConfigError, nearest

from ..engine import commands
from ..engine.engine import Engine
from ..engine.execute import prepared
from ..result import JsonObject
from .http import parse, shown

MAX_NAME_BYTES = 255
"""Longest file name on nearly all file systems."""

COMMANDS = {kind.__name__: kind for kind in typing.get_args(commands.Command)}


def command_from_json(body: object, engine: Engine) -> commands.Command:
    """Return the command of `{"command": NAME, field: value, ...}`.

    Raises:
        NisusError: If there is no such command, a field is missing, unknown or of another type, or the engine would
            refuse the command: whoever asks gets the reason at once, not as a later notice.
    """
    if not isinstance(body, dict):
        raise ConfigError(f'the body is {shown(body)}; it must be like {{"command": "Reset"}}')
    if "command" not in body:
        raise ConfigError(f"command is missing; {nearest('', COMMANDS)}")
    name = body["command"]
    if not isinstance(name, str) or name not in COMMANDS:
        raise ConfigError(f"command is {shown(name)}; {nearest(name if isinstance(name, str) else '', COMMANDS)}")
    command = parse(COMMANDS[name], {key: value for key, value in body.items() if key != "command"}, name)
    if isinstance(command, commands.Record) and command.path is not None:
        path = _recording(str(body["path"]))
        if engine.recorder is not None:
            path = engine.recorder.folder / path
            if os.path.lexists(path):
                raise ConfigError(f"Record: path is {shown(path.name)}, which exists already; choose another name")
        command = dataclasses.replace(command, path=path)
    prepared(command, engine)
    return command


def _recording(name: str) -> Path:
    """Check the name of a new recording: a browser names the file, but neither its folder nor one to replace."""
    path, where = Path(name), f"Record: path is {shown(name)}"
    if path.suffix != ".rrd" or name != path.name or "\\" in name or name.startswith("."):
        raise ConfigError(f"{where}; it must be a file name that ends in .rrd, without folders")
    if not name.isprintable():
        raise ConfigError(f"{where}; it must have letters that can be shown, no control characters")
    if len(os.fsencode(name)) > MAX_NAME_BYTES:
        raise ConfigError(f"{where}, which is too long; it may have {MAX_NAME_BYTES} bytes")
    return path


def commands_schema() -> JsonObject:
    """Return the JSON Schema of the body of a command."""
    kinds = []
    for name, kind in COMMANDS.items():
        schema = TypeAdapter(kind).json_schema()
        schema["properties"] = {"command": {"const": name}, **schema.get("properties", {})}
        schema["required"] = ["command", *schema.get("required", ())]
        kinds.append(schema)
    return {"oneOf": kinds}
