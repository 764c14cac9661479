"""`nisus fleet`: many assets of one twin."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from config.yaml_files import writing
from estimators.errors import ConfigError
from estimators.fleet import FleetTable

from ..live.fleet import RunningFleet
from ..present.export.track_file import encoded
from ..present.fleet_table import arrow_table, counts_of, fleet_topics, ordered
from ..present.result import to_json, to_text
from ..terminal import EndRequest, restore, when_asked_to_end
from ..twin.fleet import FleetPlan, load_fleet
from ..twin.log_reader import remarking
from ..web.fleet import FleetApi
from ..web.service import Service
from .options import settings
from .prepare import attend, compile_for
from .serve import PRELOADED, door_of, run_child, serve_until_end

if TYPE_CHECKING:
    from ..web.door import Door
    from ..web.running import OpenedTwin
    from ..web.session import Session
    from .arguments import FleetCommand


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
    plan = load_fleet(arguments.fleet, overrides)
    door = None if arguments.headless else door_of(arguments)
    plan.check_files()
    compile_for(plan.twin)
    report, store = remarking(lambda *_: None), arguments.store
    if store is not None and store.is_dir():
        store = store / f"{plan.name}.store"
    running = attend(None, lambda: RunningFleet(plan, report, store=store), "compiling the fleet, once")
    if door is None:
        _fold(running, arguments.duration)
    else:
        _serve(running, door, arguments, overrides)
    _, _, table = running.table()
    if not len(table.assets) or not table.events.any():
        place = plan.source.loaded.places.at(("source",))
        raise ConfigError(f"{place}: the source has no values for any sensor; check the channel maps")
    if out is not None:
        _write(out, plan, table)
    if door is not None:
        return 0
    topics = fleet_topics(plan.twin.model, table, arguments.worst)
    print(_json(plan, table) if arguments.json else "\n".join(to_text(topics)))
    return 0


def _fold(running: RunningFleet, duration: float | None) -> None:
    """Read and fold until the source or the duration ends, or the program is asked to end."""
    done = EndRequest()
    previous = when_asked_to_end(done.set)
    end = time.monotonic() + (duration or float("inf"))
    try:
        running.run(lambda: time.monotonic() < end and not done.wait(0.0))
    except KeyboardInterrupt:
        pass
    finally:
        running.stop()
        restore(previous)


def _serve(running: RunningFleet, door: Door, arguments: FleetCommand, overrides: Mapping[str, str]) -> None:
    """Serve the overview and pages of assets until the duration is over, or the program is asked to end."""
    opened = partial(_opened, arguments.fleet, overrides, arguments.recordings)
    preload = (*PRELOADED, __name__, "pyarrow.dataset", "pyarrow.parquet")
    service = Service({}, partial(run_child, opened, False), door=door, preload=preload, overview=FleetApi(running))
    running.start()
    try:
        serve_until_end(service, f"the fleet {running.plan.name}", arguments.duration)
    finally:
        running.stop()


def _opened(
    fleet: Path, overrides: Mapping[str, str], recordings: Path, name: str, asset: str
) -> tuple[Session, Mapping[str, Any]]:
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
