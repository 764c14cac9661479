"""`nisus fleet`: many assets of one twin."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

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
from .options import settings
from .prepare import attend, compile_for

if TYPE_CHECKING:
    from .arguments import FleetCommand


def run_fleet(arguments: FleetCommand) -> int:
    """Run the command."""
    out = arguments.out
    if out is not None and out.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"--out {out}: must end in .csv or .parquet")
    if arguments.worst < 1:
        raise ConfigError(f"--worst {arguments.worst}: must be positive")
    plan = load_fleet(arguments.fleet, settings(arguments.set, arguments.estimator, arguments.tuning))
    plan.check_files()
    compile_for(plan.twin)
    running = attend(None, lambda: RunningFleet(plan, remarking(lambda *_: None)), "compiling the fleet, once")
    _fold(running, arguments.duration)
    _, _, table = running.table()
    if not len(table.assets) or not table.events.any():
        place = plan.source.loaded.places.at(("source",))
        raise ConfigError(f"{place}: the source has no values for any sensor; check the channel maps")
    if out is not None:
        _write(out, plan, table)
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
