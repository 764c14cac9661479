"""`nisus fleet`: many assets of one twin."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from config.yaml_files import writing
from estimators.errors import ConfigError
from estimators.fleet.table import FleetTable
from sources.source import Partition

from ..live.fleet import RunningFleet
from ..present.export.track_file import encoded
from ..present.fleet_table import arrow_table, counts_of, fleet_topics, in_name_order, ordered
from ..present.result import to_json, to_text
from ..terminal import EndRequest, restore, when_asked_to_end
from ..twin.fleet import FleetPlan, load_fleet
from ..twin.log_reader import remarking
from ..web.fleet import FleetApi
from ..web.partitions import PartitionedFleet, PartitionServer, store_of, threads_of
from ..web.service import Service
from .options import settings
from .prepare import attend, compile_for
from .serve import PRELOADED, Opened, door_of, report_of, run_child, serve_until_end

if TYPE_CHECKING:
    from ..web.door import Door
    from ..web.running import OpenedTwin
    from .arguments import FleetCommand

FLEET_PRELOADED = (*PRELOADED, __name__, "pyarrow.dataset", "pyarrow.parquet")
"""Modules that the processes of a fleet and its pages share."""

COMPILING = "compiling the fleet, once"

LOOK_PERIOD_S = 0.1
"""Seconds between two looks whether all partitions have ended."""


def run_fleet(arguments: FleetCommand) -> int:
    """Run the command."""
    out = arguments.out
    if out is not None and out.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"--out {out}: must end in .csv or .parquet")
    if arguments.worst < 1:
        raise ConfigError(f"--worst {arguments.worst}: must be positive")
    if arguments.json and not arguments.headless:
        raise ConfigError("--json: is the result of a run without a page; give --headless")
    overrides = settings(arguments.set, arguments.estimator, arguments.tuning)
    plan = load_fleet(arguments.fleet, overrides, arguments.processes)
    door = None if arguments.headless else door_of(arguments)
    plan.check_files()
    compile_for(plan.twin)
    report, store = remarking(lambda *_: None), arguments.store
    if store is not None and store.is_dir():
        store = store / f"{plan.name}.store"
    running: RunningFleet | PartitionedFleet
    if plan.config.processes > 1:
        opened = partial(open_partition, arguments.fleet, overrides, plan.config.processes, store)
        child = partial(run_child, opened, False)
        running = attend(None, lambda: PartitionedFleet(plan, report, child, preload=FLEET_PRELOADED), COMPILING)
    else:
        running = attend(None, lambda: RunningFleet(plan, report, store=store), COMPILING)
    if door is not None:
        _serve(running, door, arguments, overrides)
    else:
        _fold(running, arguments.duration)
    _, _, table = running.table()
    if not len(table.assets) or not table.events.any():
        place = plan.source.loaded.places.at(("source",))
        raise ConfigError(f"{place}: the source has no values for any sensor; check the channel maps")
    table = in_name_order(table)
    if out is not None:
        _write(out, plan, table)
    if door is not None:
        return 0
    topics = fleet_topics(plan.twin.model, table, arguments.worst)
    print(_json(plan, table) if arguments.json else "\n".join(to_text(topics)))
    return 0


def _fold(running: RunningFleet | PartitionedFleet, duration: float | None) -> None:
    """Read and fold until the source or the duration ends, or the program is asked to end."""
    done = EndRequest()
    previous = when_asked_to_end(done.set)
    end = time.monotonic() + (duration or float("inf"))
    try:
        if isinstance(running, RunningFleet):
            running.run(lambda: time.monotonic() < end and not done.wait(0.0))
        else:
            running.start()
            while time.monotonic() < end and not (done.wait(LOOK_PERIOD_S) or running.has_ended()):
                pass
            running.table()
    except KeyboardInterrupt:
        pass
    finally:
        running.stop()
        restore(previous)


def _serve(
    running: RunningFleet | PartitionedFleet, door: Door, arguments: FleetCommand, overrides: Mapping[str, str]
) -> None:
    """Serve the overview and pages of assets until the duration is over, or the program is asked to end."""
    opened = partial(_opened, arguments.fleet, overrides, arguments.recordings)
    overview = FleetApi(running)
    service = Service({}, partial(run_child, opened, False), door=door, preload=FLEET_PRELOADED, overview=overview)
    running.start()
    try:
        serve_until_end(service, f"the fleet {running.plan.name}", arguments.duration)
    finally:
        running.stop()


def open_partition(
    fleet: Path, overrides: Mapping[str, str], processes: int, store: Path | None, name: str, number: str
) -> Opened:
    """Open the partition of a fleet that has a number."""
    plan, partition = load_fleet(fleet, overrides, processes), Partition(int(number), processes)
    running = RunningFleet(
        plan, remarking(lambda *_: None), threads=threads_of(processes), store=store_of(store, partition),
        partition=partition,
    )  # fmt: skip
    served = PartitionServer(running)
    return Opened(served, {}, served.report)


def _opened(fleet: Path, overrides: Mapping[str, str], recordings: Path, name: str, asset: str) -> Opened:
    """Open the history of an asset."""
    from ..web.gallery.gallery import StartRequest
    from ..web.session import Page
    from .open_twin import FileOpener, open_session, opened_twin

    folder = tempfile.TemporaryDirectory(prefix="nisus-")  # removed at the end of the process

    def read() -> OpenedTwin:
        plan = load_fleet(fleet, overrides)
        history = plan.history_of(asset, Path(folder.name))
        return opened_twin(str(plan.twin.path), overrides={**overrides, **history})

    opener = FileOpener({asset: read})
    session = open_session(
        opener.made_ready(read()), StartRequest(asset), opener, page=Page(0, False, overview="../../"),
        recordings=recordings / name,
    )  # fmt: skip
    return Opened(session, {}, partial(report_of, session))


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
