"""`nisus fleet`: many assets of one twin."""

from __future__ import annotations

import itertools
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.options import overrides_of
from app.cli.prepare import attend, compile_for
from app.extensions.archive.parts import ArchivePlan
from app.extensions.service.command import PRELOADED, run_child, serve_until_end, server_of
from app.extensions.service.service import Service
from app.extensions.service.supervisor import Supervisor
from app.record.rrd_file import parse_split
from app.render.text import to_text
from app.render.track_file import encoded
from app.result import to_json
from app.terminal import complain, until_asked_to_end
from app.twin.log_reader import remarking
from app.web.http_server import HttpServer
from config.yaml_files import writing
from estimators.errors import ConfigError, NisusError, SourceError
from estimators.fleet.table import FleetTable

from .api import FleetApi
from .archive import AssetHistory, FleetArchive
from .arguments import FleetCommand
from .plan import FleetPlan, load_fleet
from .publisher import FleetPublisher
from .running import STOPPED, STORE, RunningFleet
from .table import arrow_table, counts_of, fleet_topics, in_name_order, ordered

if TYPE_CHECKING:
    from pyarrow import Table

    from app.web.running import OpenedTwin
    from app.web.session import Session

FLEET_PRELOADED = (*PRELOADED, __name__, "pyarrow.dataset", "pyarrow.parquet")
"""Modules that the processes of a fleet and its pages share."""

COMPILING = "compiling the fleet, once"

FOLLOW_PERIOD_S, FOLLOW_SHARE = 2.0, 0.05
"""Shortest time between two looks of an asset's page into the archive, and the share of time that they may take."""


def run_fleet(arguments: FleetCommand) -> int:
    """Run a fleet, with its overview or until its files end."""
    out = arguments.out
    if out is not None and out.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"--out {out}: must end in .csv or .parquet")
    if arguments.worst < 1:
        raise ConfigError(f"--worst {arguments.worst}: must be positive")
    if arguments.json and not arguments.headless:
        raise ConfigError("--json: is the result of a run without a page; give --headless")
    overrides = overrides_of(arguments)
    plan = load_fleet(arguments.fleet, overrides)
    http_server = None if arguments.headless else server_of(arguments)
    plan.check_files()
    compile_for(plan.twin)
    store = arguments.store
    report = remarking(print_problem)
    if store is not None and store.is_dir():
        store = store / f"{plan.name}.store"
    archive = None
    if arguments.archive is not None:
        if plan.reads_files:
            raise ConfigError("--archive: the source is tables, which are kept already; leave it out")
        split = parse_split(arguments.archive_split, arguments.archive_keep, "--archive")
        archive = ArchivePlan(arguments.archive / plan.name, split)
    running = attend(None, lambda: RunningFleet(plan, report, store=store), COMPILING)
    if archive is not None:

        def say(key: str, text: str) -> None:
            complain(text)
            running.note(key, text)

        running.archive = FleetArchive(archive, plan.twin.model, running.names, say, running.archived)
    page = None if http_server is None else http_server.site
    if not plan.ends:
        publisher = FleetPublisher(running, page=page)
        running.end_publishing = publisher.stop
        publisher.start()
    if http_server is not None:
        _serve(running, http_server, arguments, overrides, archive)
    else:
        _fold(running, arguments.duration)
    _, _, table = running.table()
    if not len(table.assets) or not table.events.any():
        place = plan.source.loaded.places.at(("source",))
        if plan.ends:
            raise ConfigError(f"{place}: the source has no values for any sensor; check the channel maps")
        if http_server is None or out is not None:
            raise SourceError(f"{place}: no measurement arrived; check that its senders run")
        return 0
    table = in_name_order(table)
    if out is not None:
        _write(out, plan, table)
    if http_server is not None:
        return 0
    topics = fleet_topics(plan.twin.model, table, arguments.worst)
    print(_json(plan, table) if arguments.json else to_text(topics))
    return 0


def _fold(running: RunningFleet, duration: float | None) -> None:
    """Read and fold until the source or the duration ends, or the program is asked to end."""
    end = time.monotonic() + (duration or float("inf"))
    with until_asked_to_end(running.stop) as done:
        running.run(lambda: time.monotonic() < end and not done.wait(0.0))


def _serve(
    running: RunningFleet,
    http_server: HttpServer,
    arguments: FleetCommand,
    overrides: Mapping[str, str],
    archive: ArchivePlan | None,
) -> None:
    """Serve the overview and pages of assets until the duration is over, or the program is asked to end."""
    archived = None if archive is None else archive.folder
    opened = partial(_opened, arguments.fleet, overrides, arguments.recordings, archived)
    overview = FleetApi(running)
    supervisor = Supervisor({}, partial(run_child, opened, False), preload=FLEET_PRELOADED, on_demand=True)
    try:
        service = Service(supervisor, http_server=http_server, overview=overview)
        running.start()
        serve_until_end(service, f"the fleet {running.plan.name}", arguments.duration)
    finally:
        running.stop()


def print_problem(key: str, text: str) -> None:
    """Print a report of a running fleet that is not one of many alike."""
    if key in (STORE, STOPPED):
        complain(text)


def follow(history: AssetHistory, rows: Table, folder: Path, most: int) -> threading.Event:
    """Write rows of an asset into a file of a folder, and later ones into others, in a thread until it is ended."""
    import pyarrow.parquet

    numbers, ended = itertools.count(), threading.Event()

    def write(rows: Table) -> None:
        if rows is not None:
            pyarrow.parquet.write_table(rows, folder / f"{next(numbers):08d}.parquet")

    def go_on() -> None:
        pause = FOLLOW_PERIOD_S
        while not ended.wait(pause):
            begun = time.monotonic()
            with suppress(NisusError, OSError):  # at the end of the process, the folder is removed
                write(history.read(most))
            pause = max(FOLLOW_PERIOD_S, (time.monotonic() - begun) / FOLLOW_SHARE)

    write(rows)
    threading.Thread(target=go_on, name="archive", daemon=True).start()
    return ended


def _opened(
    fleet: Path, overrides: Mapping[str, str], recordings: Path, archived: Path | None, name: str, asset: str
) -> tuple[Session, Mapping[str, object]]:
    """Open the history of an asset."""
    from app.cli.open_twin import FileOpener, open_session, opened_twin
    from app.web.gallery.gallery import StartRequest
    from app.web.session import Page

    folder = tempfile.TemporaryDirectory(prefix="nisus-")  # removed at the end of the process

    following: list[threading.Event] = []

    def read() -> OpenedTwin:
        plan = load_fleet(fleet, overrides)
        if archived is None:
            history = plan.history_of(asset, Path(folder.name))
        else:
            place = Path(tempfile.mkdtemp(dir=folder.name))
            known, most = AssetHistory(archived, asset), plan.twin.config.history
            rows = known.read(most)
            if rows is None:
                raise ConfigError("the archive has no measurements of it yet")
            for ended in following:  # of a page that is opened anew
                ended.set()
            following[:] = [follow(known, rows, place, most)]
            history = plan.archived(asset, place, (rows["t_ns"][-1].as_py() - rows["t_ns"][0].as_py()) * 1e-9)
        return opened_twin(str(plan.twin.path), overrides={**overrides, **history})

    opener = FileOpener({asset: read})
    session = open_session(
        opener.made_ready(read()), StartRequest(asset), opener, page=Page(0, False, overview="../../"),
        recordings=recordings / name,
    )  # fmt: skip
    return session, {}


def _write(path: Path, plan: FleetPlan, table: FleetTable) -> None:
    model = plan.twin.model
    with writing(path, "--out"), path.open("wb") as file:
        file.writelines(encoded(path.suffix[1:], [arrow_table(model, table, ordered(model, table))]))


def _json(plan: FleetPlan, table: FleetTable) -> str:
    model = plan.twin.model
    rows = arrow_table(model, table, ordered(model, table))
    return to_json(
        {
            "fleet": plan.name, "twin": plan.twin.name, "estimator": plan.twin.estimator,
            "assets": len(table.assets), "counts": counts_of(table),
            "columns": rows.column_names, "rows": [list(row.values()) for row in rows.to_pylist()],
        }
    )  # fmt: skip
