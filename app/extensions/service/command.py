"""`nisus serve`: several twins behind one port, each in a process of its own."""

from __future__ import annotations

import gc
import ipaddress
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

from app.record.rrd_file import NEVER, Split, parse_split
from app.result import JsonObject
from app.terminal import until_asked_to_end, use_lines_of_json, when_asked_to_end
from app.web.access import NEEDS_TOKENS, Grant, grants_of
from app.web.http_server import LOOPBACK, HttpServer, check_port
from config.loader import shipped
from estimators.errors import ConfigError, NisusError, is_blank, quoted

from .arguments import ServeCommand, ServiceOptions
from .service import BLANK, Service, TwinFolder
from .supervisor import STATUS_PERIOD_S, Supervisor, forget_safe_path

if TYPE_CHECKING:
    from app.web.session import Session

PRELOADED = (f"{__package__}.preloaded",)
"""Modules that the processes of the twins share: they are imported once."""


OpenTwin = Callable[[str, str], "tuple[Session, Mapping[str, object]]"]
"""Opens a twin, given its name and path; returns its session and its card in the overview."""

MEMORY_PERIOD_S = 10.0
"""Between two looks at the memory, which take milliseconds."""


class TwinPlaces(NamedTuple):
    """Files that all twins of a service have in common, and the address of its overview."""

    store: Path | None
    recordings: Path
    json: bool
    archive: Path | None = None
    split: Split = NEVER
    site: str = ""


def serve(arguments: ServeCommand) -> int:
    """Serve twins until Ctrl-C."""
    grants = _grants(arguments)
    twins, folder = _named(arguments.twins)
    split = parse_split(arguments.archive_split, arguments.archive_keep, "--archive")
    json = arguments.log_format == "json"
    options = TwinPlaces(arguments.store, arguments.recordings, json, arguments.archive, split)
    for place in (options.store, options.recordings, options.archive):
        if place is not None and place.exists() and not place.is_dir():
            raise ConfigError(f"{place}: must be a folder, in which each twin has its own file")
    http_server = server_of(arguments, grants)
    options = options._replace(site=http_server.site)
    supervisor = Supervisor(
        twins, partial(run_child, partial(_opened, options), options.json), preload=PRELOADED,
        at_once=max(1, (os.cpu_count() or 2) // 2),
        folder=folder,
    )  # fmt: skip
    return serve_until_end(Service(supervisor, http_server=http_server), f"{len(twins)} twin(s)", arguments.duration)


def _grants(arguments: ServiceOptions) -> tuple[Grant, ...]:
    """Return the tokens of the users, who are needed where others can reach the service."""
    if arguments.tokens is None and not _is_loopback(arguments.host):
        raise ConfigError(f"--host {arguments.host}: {NEEDS_TOKENS}")
    return grants_of(arguments.tokens, arguments.public)


def server_of(arguments: ServiceOptions, grants: tuple[Grant, ...] | None = None) -> HttpServer:
    """Return the HTTP server of a service.

    Raises:
        ConfigError: If the port is not free, or others can reach it without tokens.
    """
    grants = _grants(arguments) if grants is None else grants
    loopback = _is_loopback(arguments.host)
    if loopback:
        check_port(arguments.port)
    host = LOOPBACK if loopback else arguments.host
    return HttpServer(arguments.port, grants, host=host, public=arguments.public)


def serve_until_end(service: Service, what: str, duration: float | None) -> int:
    """Serve until the duration is over, or the program is asked to end."""
    end = time.monotonic() + (duration or float("inf"))
    with until_asked_to_end(service.stop) as done:
        service.start()
        print(f"Nisus serves {what} at\n\n    {service.http_server.url}\n\nCtrl-C ends it.", flush=True)
        while time.monotonic() < end and not done.wait(min(1.0, end - time.monotonic())):
            pass
    return 0


def _named(given: tuple[str, ...]) -> tuple[dict[str, str], TwinFolder | None]:
    """Return the twins by name, and the folder that has them, if one was given.

    Raises:
        ConfigError: If there are none, or two of one name.
    """
    if len(given) == 1 and Path(given[0]).is_dir():
        folder = TwinFolder(Path(given[0]))
        return folder(), folder
    if not given:
        raise ConfigError("serve: the twins are missing; give YAML files, names of bundled twins, or a folder")
    found: dict[str, str] = {}
    for text in given:
        name = text if text in shipped() else Path(text).stem
        if Path(text).is_dir():
            raise ConfigError(f"{text}: is a folder; give it alone, or files")
        if text not in shipped() and not Path(text).is_file():
            raise ConfigError(f"{text}: there is no such file or bundled twin; check the path")
        if is_blank(name):
            raise ConfigError(f"{quoted(text)}: {BLANK}")
        if name in found:
            raise ConfigError(f"{text}: a twin is called {name} already; rename the file")
        found[name] = text
    return found, None


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise ConfigError(f"--host {host}: must be an IP address, such as 0.0.0.0 for all of this machine") from None


def run_child(open_: OpenTwin, json: bool, name: str, path: str, pipe: Connection) -> None:
    """Run one twin in this process until it is asked to stop, or the service has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the service, which stops this process
    forget_safe_path()
    done = threading.Event()
    when_asked_to_end(lambda: os._exit(0) if not running else ending.append(True))
    running: list[bool] = []
    ending: list[bool] = []
    gc.freeze()
    if json:
        use_lines_of_json()
    try:
        session, card = open_(name, path)
        session.start()
    except NisusError as error:
        with suppress(OSError):  # the service has ended
            pipe.send(("failed", str(error).splitlines()[0]))
        sys.exit(2)
    running.append(True)
    assert session.http_server is not None
    try:
        pipe.send(("ready", (session.http_server.port, session.http_server.token, card)))
        memory, measured = 0, -MEMORY_PERIOD_S
        while not (ending or done.is_set()):
            if time.monotonic() - measured > MEMORY_PERIOD_S:
                memory, measured = _memory(), time.monotonic()
            pipe.send(("report", {**report_of(session), "memory": memory}))
            if pipe.poll(STATUS_PERIOD_S):
                _take(pipe, session, done)
        # A request that stops it is noted after it was carried out.
        while pipe.poll(0.1):
            _take(pipe, session, done)
    except (EOFError, OSError):  # the service has ended
        pass
    finally:
        session.stop()


def _take(pipe: Connection, session: Session, done: threading.Event) -> None:
    """Carry out a message of the service: (kind, content)."""
    kind, content = pipe.recv()
    if kind == "stop":
        done.set()
    elif kind == "audit" and session.running is not None:
        session.engine.audit.add(*content)


def _opened(options: TwinPlaces, name: str, path: str) -> tuple[Session, Mapping[str, object]]:
    from dataclasses import asdict

    from app.cli.open_twin import FileOpener, open_session, opened_twin
    from app.web.gallery.cards import card_of
    from app.web.gallery.gallery import StartRequest
    from app.web.session import Page

    store = None if options.store is None else options.store / f"{name}.store"
    read = partial(opened_twin, path, store=store, archive=options.archive, split=options.split)
    opener = FileOpener({path: read})
    opening = opener.made_ready(read())
    page = Page(0, False, overview="../../", site=f"{options.site}/twins/{quote(name, safe='')}")
    session = open_session(
        opening, StartRequest(path), opener, page=page,
        recordings=options.recordings / name, printed=True,
    )  # fmt: skip
    return session, asdict(card_of(path, opening.twin))


def report_of(session: Session) -> JsonObject:
    """Return what the overview shows of a twin."""
    from estimators.track import HEALTH_NAMES

    running = session.running
    if running is None:
        return {"health": "waiting", "cause": "starting anew"}
    status = running.engine.status()
    cause = "the filter is being compiled" if status.awaited is not None else status.cause
    return {
        "health": HEALTH_NAMES[status.health],
        "cause": cause,
        "episodes": status.episodes_open,
        "measurements": int(status.counts.get("readings", 0)),
        "age": None if status.t is None else round(time.monotonic() - status.heard, 1),
        "unread": running.server.unread,
        "cpu": round(time.process_time(), 2),
    }


def _memory() -> int:
    """Return the bytes of this process, with its share of those in common with others; 0 where not known."""
    try:
        for line in Path("/proc/self/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return 0
