"""`python -m tests.benchmarks.fleet [ASSETS ...]`: start and tick of a fleet, beside the bits of single folds.

A tick is one measurement of every sensor of every asset: `add`, then `advance`. Times are of the clock and, as "cpu",
of all threads together: means over ticks in which every asset takes its snapshots, and the least of these ticks. The
first ticks, before the window of NIS is full, are not timed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from estimators import MODELS, Log, Tuning
from estimators.fleet.fleet import RECENT, Fleet
from estimators.fold import Fold
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.jit import threaded

from .timing import BenchmarkRow, Bound, both, run_sections

CASES = (("kf", "motor_winding", 25.0), ("ekf", "motor_drive", 50.0))
"""Estimator, model, and the bound of a tick of 100,000 assets on four threads, ms."""

WARM_TICKS, TIMED_TICKS, SAMPLED = 60, 2 * RECENT, 5


def _tick(fleet: Fleet, logs: dict[int, Log], k: int, rng: np.random.Generator) -> tuple[float, float, float]:
    """Fold one measurement of every sensor; return seconds of `add`, and of `advance` by clock and processor."""
    model, everyone = fleet.model, np.arange(len(fleet.assets))
    t = np.full(everyone.size, float(k))
    ys = {sensor.name: 20.0 + rng.normal(size=(everyone.size, len(sensor.rows))) for sensor in model.sensors}

    def add() -> None:
        for name, y in ys.items():
            fleet.add(name, everyone, t, y)

    added, _ = both(add)
    for a, log in logs.items():
        for name, y in ys.items():
            log.add(name, float(k), y[a : a + 1])
    return added, *both(fleet.advance)


def _case(estimator: str, model: StateSpaceModel, assets: int, threads: int, bound: float) -> BenchmarkRow:
    tuning, rng = Tuning.of(model), np.random.default_rng(1)
    made: list[Fleet] = []
    started, _ = both(lambda: made.append(Fleet(estimator, model, tuning, assets=assets, threads=threads)))
    fleet = made[0]
    logs = {int(a): Log.of(model) for a in rng.choice(assets, min(SAMPLED, assets), replace=False)}
    rounds = [_tick(fleet, logs, k, rng) for k in range(WARM_TICKS + TIMED_TICKS)][WARM_TICKS:]
    added, folded, spent = (sum(column) / len(rounds) * 1e3 for column in zip(*rounds, strict=True))
    least = min(seconds for _, seconds, _ in rounds) * 1e3
    shown, _ = both(fleet.table)
    table = fleet.table()
    for a, log in logs.items():
        fold = Fold(estimator, model, tuning, log)
        fold.advance()
        assert fold.track.mean[-1].tobytes() == table.mean[a].tobytes(), f"asset {a} differs from its fold"
        ours, its = fleet.base(a).evidence, fold.base_here().evidence
        assert ours is not None and its is not None and ours.tobytes() == its.tobytes(), f"detectors of {a} differ"
    figures = {
        "threads": fleet.threads, "start s": started, "add ms": added, "advance ms": folded, "least ms": least,
        "cpu ms": spent, "cpu µs/event": spent * 1e3 / (assets * len(model.sensors)), "table ms": shown * 1e3,
        "B/asset": fleet.nbytes / assets, "late 0": Fleet(estimator, model, tuning, assets=1, recent=0).nbytes,
    }  # fmt: skip
    bounds = (
        (Bound("start s", 5.0), Bound("advance ms", bound), Bound("B/asset", 4096.0), Bound("late 0", 4096.0))
        if assets == 100_000
        else ()
    )
    return BenchmarkRow(f"{estimator} {model.name} {assets:,}", figures, bounds, "sampled assets: same bits")


def fleets(sizes: list[int], threads: list[int]) -> Iterator[BenchmarkRow]:
    """Fleets: start, one measurement of every sensor of every asset, and memory."""
    for estimator, name, bound in CASES:
        Fleet(estimator, MODELS[name], assets=1)  # compiles
        for assets in sizes:
            for count in threads:
                yield _case(estimator, MODELS[name], assets, count, bound)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.fleet", description=__doc__)
    parser.add_argument("assets", nargs="*", type=int, default=[100, 10_000, 100_000], help="sizes of the fleet")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2] if threaded() else [1])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    section = partial(fleets, given.assets, given.threads)
    section.__doc__, section.__module__, section.__name__ = fleets.__doc__, __name__, "fleets"  # type: ignore[attr-defined]
    run_sections([section], given.json)


if __name__ == "__main__":
    main()
