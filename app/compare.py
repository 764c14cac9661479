"""`nisus compare`: every filter that applies to a twin, folded over the same log, in a table."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from estimators.diagnostics import HealthPolicy
from estimators.errors import ConfigError, NisusError
from estimators.fold import Fold
from estimators.log import Log, Readings
from estimators.model import StateSpaceModel
from estimators.registry import ESTIMATORS, find_estimator, unfit
from estimators.score import Fit, Score, score

from .cli import settings
from .compile import prepare
from .fold import read_log
from .twin import Twin, load_twin

if TYPE_CHECKING:
    from .cli import Compare as Arguments

BEGIN, END = "# nisus compare", "# end of nisus compare"
"""Lines around the table in a YAML's head."""

ENOUGH = 0.2
"""Seconds that a fold is timed for."""


@dataclass(frozen=True)
class Row:
    """What one filter made of the log.

    `rmse` by unit: the root mean square over the states of that unit whose truth is known, or, where no truth is,
    over the sensors held out. `coverage` is the share of those errors inside their 95 % band. `failure` says why
    there are no numbers.
    """

    estimator: str
    rmse: dict[str, float]
    nis: float
    nis_low: float
    nis_high: float
    coverage: float
    seconds_per_event: float
    failure: str = ""


def compare_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    twin = load_twin(arguments.twin, log_files=arguments.log or None, overrides=settings(arguments.set))
    names = _chosen(twin, arguments.estimators)
    prepare(twin)
    log, _ = read_log(twin, arguments.duration)
    rows = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"{len(names)} filters over {log.n} events", total=len(names))
        for row in compare(arguments.twin, settings(arguments.set), names, log.readings, arguments.jobs):
            rows.append(row)
            progress.advance(task)
    rows.sort(key=lambda row: names.index(row.estimator))
    if arguments.json:
        print(json.dumps([_plain(row) for row in rows]))
    else:
        print("\n".join(table(rows)))
    if arguments.write:
        write_table(twin.path, rows)
    return 0


def _plain(row: Row) -> dict[str, Any]:
    def number(value: Any) -> Any:
        return None if isinstance(value, float) and not np.isfinite(value) else value

    values = asdict(row)
    values["rmse"] = {unit: number(value) for unit, value in row.rmse.items()}
    return {name: number(value) for name, value in values.items()}


def _chosen(twin: Twin, wanted: Sequence[str]) -> list[str]:
    """The filters to compare: those asked for, or all that apply."""
    if wanted:
        for name in wanted:
            find_estimator(name, twin.model)
        return list(dict.fromkeys(wanted))
    return [name for name, entry in ESTIMATORS.items() if unfit(entry, twin.model) is None]


def compare(
    twin: str, overrides: dict[str, str], names: Sequence[str], events: Readings, jobs: int | None = None
) -> Iterator[Row]:
    """Fold each filter over the events, in processes of their own; rows come as they are done.

    Args:
        twin: Name or path.
        overrides: See `load_twin`.
        names: Of the filters.
        events: The log's.
        jobs: Processes; None for one a processor.
    """
    jobs = min(len(names), jobs or os.cpu_count() or 1)
    # Spawned: the libraries that the filters' threads come from do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        futures = [pool.submit(fold_one, twin, overrides, name, tuple(events)) for name in names]
        for future in as_completed(futures):
            yield future.result()


def fold_one(name_or_path: str, overrides: dict[str, str], estimator: str, columns: tuple[np.ndarray, ...]) -> Row:
    """Fold one filter over events that are given as columns."""
    twin = load_twin(name_or_path, overrides=overrides)
    events = Readings(*columns)
    log = Log(twin.model.width, max(1, len(events)))
    log.extend(events)
    section = twin.config.time
    policy = HealthPolicy(degraded_after=section.degraded_after, stale_after=section.stale_after)
    tuning = twin.tuning.with_options(twin.options_of(estimator))
    try:
        fold = Fold(estimator, twin.model, tuning, log, pairs=twin.pairs, policy=policy)
        seconds = _timed(fold) / log.n
    except NisusError as error:
        return Row(estimator, {}, np.nan, np.nan, np.nan, np.nan, np.nan, str(error))
    return row_of(estimator, score(fold.track, log.readings, twin.model), twin.model, seconds)


def _timed(fold: Fold) -> float:
    """Fold everything; a short one again and again, as other work disturbs it. The shortest time, s."""
    begun = time.perf_counter()
    fold.advance()
    took = [time.perf_counter() - begun]
    while sum(took) < ENOUGH:
        fold.rewind(0)
        begun = time.perf_counter()
        fold.advance()
        took.append(time.perf_counter() - begun)
    return min(took)


def row_of(estimator: str, result: Score, model: StateSpaceModel, seconds: float) -> Row:
    """A score as a row of the table."""
    fits, units = result.states, {state.name: state.unit for state in model.states}
    if not fits:
        fits = result.held_out
        row_units = [row.unit for sensor in model.sensors for row in sensor.rows]
        units = dict(zip(model.row_names, row_units, strict=True))
    groups: dict[str, list[Fit]] = {}
    for name, fit in fits.items():
        groups.setdefault(units[name], []).append(fit)
    # A probability has no band (see `StateSpaceModel.label`).
    mode = model.jump.state if model.jump else None
    covered = [fit.coverage for name, fit in fits.items() if name != mode]
    return Row(
        estimator,
        {unit: float(np.sqrt(np.mean([fit.rmse**2 for fit in group]))) for unit, group in groups.items()},
        result.nis,
        result.nis_low,
        result.nis_high,
        float(np.mean(covered)) if covered else np.nan,
        seconds,
        "" if np.isfinite(result.nis) else "diverged",
    )


def table(rows: Sequence[Row]) -> list[str]:
    """The rows as lines of text: filter, RMSE by unit, mean NIS with its 95 % bounds, coverage, cost."""
    units = list(dict.fromkeys(unit for row in rows for unit in row.rmse))
    head = ["filter", *(f"RMSE [{unit}]" for unit in units), "mean NIS", "95 % bounds", "in band", "µs/event"]
    cells = [head]
    for row in rows:
        if row.failure:
            cells.append([row.estimator, row.failure])
            continue
        cells.append(
            [
                row.estimator,
                *(f"{row.rmse[unit]:.4g}" if unit in row.rmse else "" for unit in units),
                f"{row.nis:.3f}",
                f"{row.nis_low:.3f} - {row.nis_high:.3f}",
                f"{100 * row.coverage:.1f} %" if np.isfinite(row.coverage) else "",
                f"{1e6 * row.seconds_per_event:.3g}",
            ]
        )
    widths = [max(len(line[k]) for line in cells if k < len(line) and len(line) > 2) for k in range(len(head))]
    return ["  ".join(f"{cell:<{widths[k]}}" for k, cell in enumerate(line)).rstrip() for line in cells]


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Put the table into the head of a YAML, in place of the one that is there.

    Raises:
        ConfigError: If the file cannot be written.
    """
    block = "\n".join([f"{BEGIN} {path.stem}", *(f"# {line}" for line in table(rows)), END]) + "\n"
    try:
        text = path.read_text(encoding="utf-8")
        old = re.compile(rf"^{BEGIN}.*?^{END}\n", re.MULTILINE | re.DOTALL)
        path.write_text(old.sub(lambda _: block, text, count=1) if old.search(text) else block + text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; the table cannot be written") from None


def read_table(text: str) -> dict[str, list[str]]:
    """The cells of the table in a YAML's head, by filter; empty if there is none."""
    found = re.search(rf"^{BEGIN}.*?\n(.*?)^{END}$", text, re.MULTILINE | re.DOTALL)
    lines = [line.removeprefix("# ") for line in found[1].splitlines()] if found else []
    return {cells[0]: cells[1:] for cells in (re.split(r"\s{2,}", line) for line in lines[1:])}
