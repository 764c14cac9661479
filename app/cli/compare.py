"""`nisus compare`: every filter that applies to a twin, folded over the same log, in a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from config.loader import shipped
from config.source_schema import SimulatorSection
from estimators.errors import ConfigError, SourceError
from estimators.log import MARK, Events
from estimators.registry import ESTIMATORS, find_estimator, unfit

from ..present.result import to_json
from ..terminal import complain
from ..twin.twin import Twin, load_twin
from .beside import beside, jobs_of
from .compare_fold import BUDGET, Row, fold_row
from .compare_table import cells, printed
from .fold import read_log
from .given import settings
from .prepare import prepare
from .progress import progress
from .scores import write_scores

if TYPE_CHECKING:
    from .arguments import Compare as Arguments

ALL = "all"
"""In place of a twin's name: each that ships."""

_shared: dict[str, Any] = {}
"""Of a process that folds: the twin and the logs, which every filter takes."""


def compare_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    if arguments.twin != ALL:
        _compare(arguments, arguments.twin)
        return 0
    failed = 0
    for name in shipped():
        try:
            _compare(arguments, name)
        except SourceError as error:  # a recording that is not there
            complain(error)
            failed = 2
    return failed


def _compare(arguments: Arguments, name: str) -> None:
    overrides = settings(arguments.set, tuning=arguments.tuning)
    twin = load_twin(name, log_files=arguments.log or None, overrides=overrides)
    changed = (
        arguments.estimators
        or arguments.set
        or arguments.tuning
        or arguments.log
        or arguments.duration
        or arguments.logs > 1
    )
    if arguments.write and changed:
        raise ConfigError(
            "--write: a twin's table is that of all its filters over its own log; leave the other options out"
        )
    if arguments.logs < 1:
        raise ConfigError(f"--logs {arguments.logs}: must be 1 or more")
    names = _chosen(twin, arguments.estimators)
    prepare(twin)
    logs = _logs(twin, overrides, arguments)
    rows = []
    with progress(f"{twin.name}, {len(logs[0])} events", len(names), "filters") as advance:
        for row in compare(name, overrides, names, logs, arguments.jobs, arguments.budget):
            rows.append(row)
            advance()
    rows.sort(key=lambda row: names.index(row.estimator))
    seconds = float(logs[0].t[-1] - logs[0].t[0]) * 1e-9
    lines = cells(rows, len(logs[0]), seconds)
    if arguments.json:
        print(to_json([row_json(row) for row in rows]))
    else:
        print("\n".join(printed(twin.path.stem, lines, len(logs))))
    if arguments.write:
        write_scores(twin.path, lines)


def _logs(twin: Twin, overrides: Mapping[str, str], arguments: Arguments) -> list[Events]:
    """The twin's log, or several of its simulator, whose seeds count up from the twin's own."""
    if arguments.logs == 1:
        return [events_of(twin, arguments.duration)]
    source = twin.config.source
    if not isinstance(source, SimulatorSection):
        raise ConfigError(f"--logs {arguments.logs}: {twin.name} is not simulated; there is one log of it")
    seeds = range(source.seed, source.seed + arguments.logs)
    twins = (load_twin(arguments.twin, overrides={**overrides, "source.seed": str(seed)}) for seed in seeds)
    return [events_of(other, arguments.duration) for other in twins]


def events_of(twin: Twin, duration: float | None = None) -> Events:
    """What the twin's source says, without the stamps of faults: these say nothing of the asset, and are no steps."""
    events = read_log(twin, duration)[0].events
    return events.select(events.kind != MARK)


def row_json(row: Row) -> dict[str, Any]:
    """Return a row for scripts: every figure is its mean, with the standard deviations under `spread`."""
    figures: dict[str, Any] = {"rmse": {unit: figure.value for unit, figure in row.rmse.items()}}
    spreads: dict[str, Any] = {"rmse": {unit: figure.spread for unit, figure in row.rmse.items()}}
    for name in ("nis", "coverage"):
        figures[name], spreads[name] = getattr(row, name)
    return {**asdict(row), **figures, "spread": spreads}


def _chosen(twin: Twin, wanted: Sequence[str]) -> list[str]:
    """The filters to compare: those asked for, or all that apply."""
    if wanted:
        for name in wanted:
            find_estimator(name, twin.model)
        return list(dict.fromkeys(wanted))
    return [name for name, entry in ESTIMATORS.items() if unfit(entry, twin.model) is None]


def compare(
    twin: str,
    overrides: Mapping[str, str],
    names: Sequence[str],
    logs: Sequence[Events],
    jobs: int | None = None,
    budget: float = BUDGET,
) -> Iterator[Row]:
    """Fold each filter over the logs, in processes of their own; rows come as they are done.

    Args:
        twin: Name or path.
        overrides: See `load_twin`.
        names: Of the filters.
        logs: The events; see `fold_row`.
        jobs: Processes; None for one a processor.
        budget: Seconds for a filter; see `fold_row`.
    """
    jobs = jobs_of(jobs, len(names))
    if jobs == 1:
        ready = load_twin(twin, overrides=overrides)
        threads = numba.get_num_threads()
        numba.set_num_threads(1)
        try:
            yield from (fold_row(ready, name, logs, budget) for name in names)
        finally:
            numba.set_num_threads(threads)
        return
    given = (twin, dict(overrides), [tuple(log) for log in logs])
    # The last filters of the catalogue are the slow ones.
    with beside(_fold, [(name, budget) for name in reversed(names)], jobs, _share, given) as futures:
        for future in as_completed(futures):
            yield future.result()


def _share(name: str, overrides: dict[str, str], logs: list[tuple[np.ndarray, ...]]) -> None:
    _shared["twin"] = load_twin(name, overrides=overrides)
    _shared["logs"] = [Events(*columns) for columns in logs]
    numba.set_num_threads(1)  # the processors have a filter each, and a step costs what it costs one


def _fold(estimator: str, budget: float) -> Row:
    return fold_row(_shared["twin"], estimator, _shared["logs"], budget)
