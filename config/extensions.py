"""Extensions: optional parts of Nisus, which packages register as entry points of the group `nisus.extensions`.

    [project.entry-points."nisus.extensions"]
    serial = "nisus_serial:EXTENSION"

Entry points are read once, when a command or the schema first asks for them. The schema of a twin is made of the
sections of all extensions: their modules import `config.fields` and `config.channels`, and nothing else of Nisus.
"""

from __future__ import annotations

import logging
import multiprocessing
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache, partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_type_hints

from estimators.errors import ConfigError, NisusError, printable, reason_of

GROUP = "nisus.extensions"
T = TypeVar("T")


class Part(NamedTuple):
    """One thing that an extension adds. Both are references, `module:name`, which are imported when they are needed.

    `schema` is the class of the user's settings, if any: a dataclass of options, or a `Section` of the YAML. `make` is
    called with these and the arguments that `Extension` lists. `text` describes a key in the schema of the YAML.
    """

    schema: str
    make: str
    text: str = ""


Parts = Mapping[str, Part]


@dataclass(frozen=True)
class Extension:
    """Parts that a package adds, by kind and name. The name of the extension is that of its entry point."""

    needs: tuple[str, ...] = ()
    """Names of the extensions whose modules it imports."""
    commands: Parts = field(default_factory=dict)
    """By the word after `nisus`. `make(options)` runs the command and returns the exit status."""
    sources: Parts = field(default_factory=dict)
    """Live sources of messages, by `source.type`. `make(opening)` opens one (`app.twin.sources.kind.Opening`)."""
    outputs: Parts = field(default_factory=dict)
    """By key under `outputs`. `make(section, engine, secrets)` returns an `app.engine.outputs.publisher.Output`."""
    receivers: Parts = field(default_factory=dict)
    """Of alerts, by `type`; `make(section, folder, secrets)` returns an `app.engine.outputs.receivers.Receiver`. An
    output of the same name is the receiver itself."""
    models: Parts = field(default_factory=dict)
    """Models in files, by the key of the file in `model`. `make(loaded, section, path)` returns a StateSpaceModel."""
    corrections: Parts = field(default_factory=dict)
    """Of `learned`: `file`. `make(loaded, model, path)` returns a LearnedCorrection, and its place for errors."""
    executors: Parts = field(default_factory=dict)
    """Work on other machines, at the address that `--cluster` gives. `calls`: `make(address, begin, given)`; `folds`:
    `make(address, twin, held, name, overrides)`. Each is a context manager; see `app.study.processes`."""
    tables: Parts = field(default_factory=dict)
    """Files of tables, by the ending of the name. `make` is a `sources.tables.rows.TableFormat`."""
    folders: Parts = field(default_factory=dict)
    """Folders that are one recording, by a file in them. `make(folder)` returns their files in order."""
    tracks: Parts = field(default_factory=dict)
    """Files of `nisus fold --out`, by ending. `make(path)` returns `write(file, twin, fold, smoothed)`, or refuses."""
    archives: Parts = field(default_factory=dict)
    """Of `--archive`: `rows`. `make(folder, split, engine, stored)` returns what archives the rows of a running twin
    between its `start` and `stop`."""
    pictures: Parts = field(default_factory=dict)
    """Drawn without a browser. `track`: `make(path)` returns `draw(model, events, track, episodes, title)`, which makes
    the figure to save there, or refuses; `twin`: `make(name)` draws that of the gallery, and returns its path."""
    routes: Parts = field(default_factory=dict)
    """Routes beside those of the page, by path. `make(engine)` returns one, as `app.web.http.get` does."""
    gallery: Parts = field(default_factory=dict)
    """Routes beside those of the gallery, by path, without a running twin. `make()` returns one."""
    panels: Parts = field(default_factory=dict)
    """Tabs of the page, by title. `make()` returns a JavaScript module, whose default export is called with the element
    of the tab and objects of the page: `{model, link, view, charts}` (`app/web/page/page.js`)."""


Kind = Literal[
    "commands", "sources", "outputs", "receivers", "models", "corrections", "executors", "tables", "folders", "tracks",
    "archives", "pictures", "routes", "gallery", "panels",
]  # fmt: skip
RESERVED: Mapping[Kind, tuple[str, ...]] = {
    "sources": ("simulator", "can", "can_log", "table", "merged", "push"),
    "outputs": ("every", "covariance", "receivers"),
    "receivers": (),
    "models": ("matrices",),
}
"""Names of the core in each kind of section, which no extension may take; commands of the core come before others."""

GUARDED = ("commands", "sources", "outputs", "receivers", "models", "routes", "gallery", "panels")
"""Kinds whose functions end in a line, not in a traceback; see `maker`."""

_left_out: dict[str, str] = {}


def left_out() -> str:
    """Return the end of an error about an unknown name: the extensions that cannot be loaded."""
    why = "; ".join(f"{name} ({reason})" for name, reason in _left_out.items())
    return f"; extensions that cannot be loaded: {why}" if why else ""


@cache
def extensions() -> dict[str, Extension]:
    """Return the installed extensions, by name. One that cannot be loaded is reported in a line, and left out."""
    points = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    found = {point.name: item for point in points if (item := _tried(point.name, partial(_loaded, point))) is not None}
    while lacking := {name: need for name, item in found.items() for need in item.needs if need not in found}:
        for name, need in lacking.items():
            del found[name]
            _leave_out(name, f"it needs the extension {need}")
    return found


def _loaded(point: EntryPoint) -> Extension:
    item = point.load()
    if not isinstance(item, Extension):
        raise ConfigError("its entry point names no Extension")
    if not isinstance(item.needs, tuple):
        raise ConfigError("its needs are no tuple")
    for kind in get_args(Kind):
        own = getattr(item, kind)
        if not isinstance(own, Mapping) or not all(isinstance(part, Part) for part in own.values()):
            raise ConfigError(f"its {kind} are no mapping from names to Part")
    return item


@cache
def registered(kind: Kind) -> dict[str, tuple[str, Part]]:
    """Return the parts of a kind by name, each with the name of its extension; a name that is taken is reported."""
    found: dict[str, tuple[str, Part]] = {}
    for name, item in extensions().items():
        for key, part in getattr(item, kind).items():
            if key in RESERVED.get(kind, ()) or found.setdefault(key, (name, part)) != (name, part):
                warn(f"extension {name}: {key} of its {kind} is left out, as there is one of that name")
    return found


@cache
def schemas(kind: Kind) -> dict[str, Any]:
    """Return the classes of options or sections of a kind by name, without those that cannot be imported or used."""
    parts = registered(kind).items()
    found = {key: _tried(name, partial(_usable, part.schema, kind, key)) for key, (name, part) in parts}
    return {key: schema for key, schema in found.items() if schema is not None}


def _usable(reference: str, kind: Kind, key: str) -> Any:
    """Return a class of options or sections; one that would stop every twin is refused."""
    schema = pkgutil.resolve_name(reference)
    if kind == "commands":
        fields(schema), get_type_hints(schema)  # which `nisus --help` needs of all commands
    if kind in RESERVED:
        from .channels import MessagesSection  # here, as commands without a YAML do not wait for pydantic
        from .fields import Section

        base = MessagesSection if kind == "sources" else Section
        if not issubclass(schema, base):
            raise TypeError(f"{schema.__name__} is no {base.__name__}")
        if kind == "outputs" and (key[:1] == "_" or hasattr(base, key)):
            raise TypeError(f"{key} is a name of pydantic")
        schema.model_rebuild()
        # Such a section is recognised by its type.
        if kind in ("sources", "receivers") and get_args(schema.model_fields["type"].annotation) != (key,):
            raise TypeError(f"type of {schema.__name__} is not Literal[{key!r}]")
        if kind == "models" and key not in schema.model_fields:
            raise TypeError(f"{schema.__name__} has no field {key}")
    return schema


def leave_out_undescribed() -> None:
    """Leave out the sections that have no JSON Schema; for `nisus schema`, before it imports the schema of twins."""
    for kind in RESERVED:
        for key, schema in [*schemas(kind).items()]:
            if _tried(registered(kind)[key][0], schema.model_json_schema) is None:
                del schemas(kind)[key]


def maker(kind: Kind, key: str, asked: str = "", extra: str = "") -> Callable:
    """Return the function of a part; `asked` is what needs it, and `extra` what brings it.

    In one of `GUARDED`, an error that is none of Nisus or of the system becomes a ConfigError.

    Raises:
        ConfigError: If no extension has it, or it cannot be imported.
    """
    if key not in registered(kind):
        rule = f"needs an extension; install it with `pip install 'nisus[{extra}]'`" if extra else "no extension has it"
        raise ConfigError(f"{asked}: {rule}{left_out()}")
    name, part = registered(kind)[key]
    try:
        make: Callable = pkgutil.resolve_name(part.make)
    except Exception as error:  # noqa: BLE001  the module may be of a third party
        raise ConfigError(f"extension {name}: {_gist(error)}; install its package again") from None

    def guarded(*given: object) -> object:
        try:
            found = make(*given)
        except (NisusError, OSError):
            raise
        except Exception as error:  # noqa: BLE001  the function may be of a third party
            raise ConfigError(f"extension {name}: {key} of its {kind}: {_gist(error)}") from error
        if found is None:
            raise ConfigError(f"extension {name}: {key} of its {kind}: its function returns nothing")
        return found

    return guarded if kind in GUARDED else make


def made(kind: Kind, *given: object) -> list[Any]:
    """Return what the functions of all parts of a kind make; what fails is reported, and left out."""
    parts = registered(kind).items()
    tried = (_tried(name, partial(lambda key: maker(kind, key)(*given), key)) for key, (name, _) in parts)
    return [found for found in tried if found is not None]


def _tried(name: str, work: Callable[[], T]) -> T | None:
    try:
        return work()
    except (Exception, SystemExit) as error:  # noqa: BLE001  no extension may stop a twin that does not need it
        _leave_out(name, _gist(error).removeprefix(f"extension {name}: "))
        return None


def _gist(error: BaseException) -> str:
    return printable(reason_of(error).partition("\n")[0].removesuffix(": "))


def _leave_out(name: str, why: str) -> None:
    if name not in _left_out:
        _left_out[name] = why
        warn(f"extension {name} is left out: {why}")


def warn(text: str) -> None:
    """Log a line, once for all processes of a command."""
    if multiprocessing.parent_process() is None:
        logging.getLogger("nisus").warning(text)
