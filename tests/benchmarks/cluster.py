"""Work in processes and on a Dask cluster: cost of a task, and folds that are spread over workers."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numpy as np

from app.study.check import check
from app.study.processes import executor_of, results
from app.twin.twin import load_twin, with_held
from estimators.errors import NisusError
from estimators.fit.fit import fit
from estimators.fit.recording import Recording
from estimators.log import Log
from tests.support import folded

from .folds import DEFAULT_TWIN, REFOLD_READINGS, endless_log
from .timing import BenchmarkRow

WAYS: dict[str, dict[str, Any]] = {
    "one process": {"jobs": 1},
    "2 processes": {"jobs": 2},
    "4 processes": {"jobs": 4},
    "Dask, 2 workers": {"cluster": "local:2"},
    "Dask, 4 workers": {"cluster": "local:4"},
}

FEW, MANY = 50, 550
"""Tasks without work; the cost of one is the difference, in which the start of the workers cancels."""

FOLDS = 48
SEARCHED = REFOLD_READINGS
"""Measurements of a fit."""

READINGS = 2 * REFOLD_READINGS
"""Measurements of a fold, so that it takes more than 0.1 s."""

_shared: dict[str, Any] = {}


def tasks() -> Iterator[BenchmarkRow]:
    """A task without work, in processes and on a Dask cluster on this machine: ms by the clock."""
    for name, way in WAYS.items():
        took = [_spent(int, [()] * count, way)[0] for count in (FEW, MANY)]
        yield BenchmarkRow(name, {"per task [ms]": 1e3 * (took[1] - took[0]) / (MANY - FEW), "start [s]": took[0]})


def spread_folds() -> Iterator[BenchmarkRow]:
    """Folds of one log with 48 tunings, from the first result to the last: seconds by the clock, and times faster.

    Raises:
        NisusError: If the tracks are not the same bits everywhere.
    """
    calls = [(0.01 + 0.001 * k,) for k in range(FOLDS)]
    wanted, alone = None, np.nan
    for name, way in WAYS.items():
        whole, span, found = _spent(_fold, calls, way, begin=_share)
        wanted, alone = (found, span) if wanted is None else (wanted, alone)
        if found != wanted:
            raise NisusError(f"{name}: other bits than in one process")
        figures = {"folds [s]": span, "times faster": alone / span, "with start [s]": whole}
        yield BenchmarkRow(name, figures, remark=f"{os.cpu_count()} cores" if way.get("jobs") == 1 else "")


def searches() -> Iterator[BenchmarkRow]:
    """Fit and check of one twin: seconds by the clock, and times faster than in threads of one process.

    Raises:
        NisusError: If the fits are not the same bits everywhere.
    """
    twin = load_twin(DEFAULT_TWIN)
    held, log, counts = with_held(twin), endless_log(twin, SEARCHED), Counter[str]()
    wanted: list[str] = []
    alone: list[float] = []
    for name, cluster in {"threads": None, "Dask, 2 workers": "local:2", "Dask, 4 workers": "local:4"}.items():
        with executor_of(cluster, twin, held, DEFAULT_TWIN, {}) as executor:
            took = []
            for _ in range(2):  # the first one loads the twin on the workers
                begun = perf_counter()
                found = fit("ekf", held.tuning, [Recording(log)], blocks=0, executor=executor)
                fitted = perf_counter()
                check(twin, log.copy(), counts, executor=executor)
                took = [fitted - begun, perf_counter() - fitted]
        wanted, alone = wanted or [repr(found.lines)], alone or took
        if repr(found.lines) != wanted[0]:
            raise NisusError(f"{name}: other bits than in threads")
        figures = {"fit [s]": took[0], "times faster": alone[0] / took[0]}
        yield BenchmarkRow(name, {**figures, "check [s]": took[1], "check faster": alone[1] / took[1]})


def _spent(work: Any, calls: list[tuple[Any, ...]], way: dict[str, Any], **more: Any) -> tuple[float, float, list[Any]]:
    """Return the seconds of all calls with the start, those from the first result on, and the results in order."""
    begun, first, found = perf_counter(), 0.0, {}
    for k, result in results(work, calls, **way, **more):
        first = first or perf_counter()
        found[k] = result
    ended = perf_counter()
    # The first result comes when each worker has begun another call.
    return ended - begun, (ended - first) * len(calls) / (len(calls) - 1), [found[k] for k in sorted(found)]


def _share() -> None:
    twin = load_twin(DEFAULT_TWIN)
    _shared.update(twin=twin, log=endless_log(twin, READINGS))
    _fold(0.01)


def _fold(noise: float) -> str:
    twin, log = _shared["twin"], _shared["log"]
    assert isinstance(log, Log)
    fold = folded("ekf", twin.model, log, twin.tuning.set(twin.tuning.items()[0].key, noise), pairs=twin.pairs)
    return hashlib.sha256(fold.track.mean.tobytes() + fold.track.std.tobytes()).hexdigest()
