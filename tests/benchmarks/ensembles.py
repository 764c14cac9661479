"""What an analysis of an ensemble costs: beside DAPPER's on Lorenz 96, and on large fields, with its memory."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from estimators.compiled.model import compile_model
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import StateSpaceModel
from estimators.models.lorenz96 import LORENZ96
from estimators.models.thermal_field import thermal_field
from estimators.snapshots import Base
from estimators.track import USED
from estimators.tuning import Tuning

from .timing import both, compare, judged

CYCLES = 400
THEIR_CYCLES = 40
STEP = 0.05


def _truth(cycles: int) -> tuple[np.ndarray, np.ndarray]:
    """States of Lorenz 96 on its attractor, and readings of them with R = I."""
    f, rng = compile_model(LORENZ96).f, np.random.default_rng(1)
    x, states = LORENZ96.prior_mean + rng.standard_normal(40), np.empty((cycles + 500, 40))
    for k in range(len(states)):
        f(x, np.zeros(0), np.array([8.0]), STEP, states[k])
        x = states[k]
    return states[-cycles - 1 :], states[-cycles:] + rng.standard_normal((cycles, 40))


def _ours(name: str, options: dict[str, float]) -> Callable[[], None]:
    truth, readings = _truth(CYCLES)
    log = Log(LORENZ96.width, CYCLES)
    t = (np.arange(CYCLES, dtype=np.int64) + 1) * round(STEP * 1e9)
    log.extend(Events(t, t, np.full(CYCLES, READING, np.int8), np.zeros(CYCLES, np.int32), readings))
    tuning = Tuning.of(LORENZ96).with_options(options).set("Q.x", 0.0)
    growing = Fold(name, LORENZ96, tuning, log, base=Base(truth[0], 0.1 * np.eye(40), 0, np.zeros(0)))
    growing.advance()

    def again() -> None:
        growing.rewind(0)
        growing.advance()

    return again


def _theirs(method: Any, HMM: Any, xx: np.ndarray, yy: np.ndarray) -> Callable[[], None]:
    """DAPPER's forecasts and analyses with its statistics, as `assimilate` does them for every user."""

    def run() -> None:
        method.assimilate(HMM, xx, yy, liveplots=False)

    return run


def beside_dapper() -> None:
    """A cycle (forecast, analysis, NIS, statistics) on Lorenz 96 beside DAPPER's."""
    print("A cycle on Lorenz 96 (40 states, all read): processor time, medians, interleaved")
    try:
        import dapper
        import dapper.da_methods as da
        import dapper.tools.progressbar as progress
        from dapper.mods.Lorenz96.sakov2008 import HMM
    except ImportError:
        print("  DAPPER is not installed: pip install nisus[bench]")
        return
    progress.disable_progbar = True
    dapper.set_seed(3000)
    HMM.tseq.T, HMM.tseq.BurnIn = THEIR_CYCLES * STEP, 0.0
    xx, yy = HMM.simulate()
    rows = [
        ("EnKF   N=40", "enkf", {"members": 40, "inflation": 1.06}, da.EnKF("PertObs", N=40, infl=1.06)),
        ("ETKF   N=24", "etkf", {"members": 24, "inflation": 1.02}, da.EnKF("Sqrt", N=24, infl=1.02)),
        ("EnSRF  N=24", "ensrf", {"members": 24, "inflation": 1.02}, da.EnKF("Serial", N=24, infl=1.02)),
        (
            "LETKF  N=7 ",
            "letkf",
            {"members": 7, "inflation": 1.07, "radius": 14.56},
            da.LETKF(N=7, infl=1.07, loc_rad=4),
        ),
        (
            "LETKF  N=24",
            "letkf",
            {"members": 24, "inflation": 1.04, "radius": 14.56},
            da.LETKF(N=24, infl=1.04, loc_rad=4),
        ),
    ]
    print(f"  {'filter':12s} {'Nisus µs':>9s} {'DAPPER µs':>10s} {'ratio':>7s}   wanted")
    for title, name, options, method in rows:
        pair = compare(_ours(name, options), _theirs(method, HMM, xx, yy), steps=(CYCLES, THEIR_CYCLES), repetitions=7)
        verdict = judged(pair.ratio, 10, at_least=True)
        print(f"  {title:12s} {pair.ours * 1e6:9.1f} {pair.theirs * 1e6:10.0f} {pair.ratio:7.1f}   >= 10   {verdict}")


def _peak(reset: bool = False) -> float:
    """Most memory that the process held since the last reset, bytes (Linux)."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024.0 * float(next(line.split()[1] for line in lines if line.startswith("VmHWM")))


def analysis(model: StateSpaceModel, name: str, options: dict[str, float], repetitions: int) -> tuple[float, ...]:
    """Seconds of the clock and of the processor for one analysis, and memory in units of the ensemble's own."""
    log = Log(model.width, 16)
    rng, rows = np.random.default_rng(0), len(model.sensors[0].rows)
    for _ in range(repetitions + 1):
        # Not the same again, which would be refused as a duplicate.
        y = model.prior_mean[0] + rng.standard_normal(rows)
        log.extend(Events.one(0, 0, READING, 0, y, model.width))
    fold = Fold(name, model, Tuning.of(model).with_options(options), log)
    fold.advance(1)
    gc.collect()
    peak = _peak(reset=True)
    times = [both(lambda: fold.advance(1)) for _ in range(repetitions)]
    assert np.all(fold.track.verdict[: fold.n] == USED), "an analysis was not made"
    ensemble = fold._now.state.nbytes
    memory = (ensemble + fold._machine.work.nbytes + _peak() - peak) / ensemble
    return median(t for t, _ in times), median(t for _, t in times), memory


def large_states() -> None:
    """The analysis of a million states, 50 members, 100 rows: time and memory."""
    model = thermal_field(1000, 1000)
    print("One analysis, n = 1 000 000, N = 50, m = 100 (an ensemble of 400 MB)")
    print(f"  {'filter':22s} {'clock s':>8s} {'CPU s':>7s} {'memory':>7s}   wanted")
    rows: tuple[tuple[str, str, dict[str, float], float], ...] = (
        ("ETKF", "etkf", {"members": 50}, 0.5),
        ("EnSRF, radius 1 m", "ensrf", {"members": 50, "radius": 1.0}, 3.0),
    )
    for title, name, options, bound in rows:
        clock, cpu, memory = analysis(model, name, options, 5)
        verdict = judged(clock, bound, at_least=False), judged(memory, 1.3, at_least=False)
        print(f"  {title:22s} {clock:8.2f} {cpu:7.2f} {memory:7.2f}   <= {bound} s {verdict[0]}; <= 1.3 {verdict[1]}")


def growing_ensembles() -> None:
    """An analysis against n, N and m, each doubled or quadrupled while the others stay."""
    print("One analysis of a field: ms of the processor, and ns by the expected order in brackets")
    rows: tuple[tuple[str, dict[str, float], str, Callable[[int, int, int], float]], ...] = (
        ("etkf", {}, "n N²", lambda n, members, m: n * members**2),
        ("ensrf", {"radius": 0.5}, "n N m, within the radius", lambda n, members, m: n * members * m),
        # Each cell solves for the fewer of N and the rows within the radius: 78 of 100 at n = 10,000, 20 and 5 beyond.
        (
            "letkf",
            {"radius": 0.5},
            "n, k³ with k the smaller of N and the rows within the radius",
            lambda n, members, m: n,
        ),
    )
    cases = [(side, 40, 10) for side in (100, 200, 400)] + [(200, N, 10) for N in (10, 20, 80)]
    cases += [(200, 40, sensors) for sensors in (5, 20)]
    for name, options, order, count in rows:
        print(f"  {name}, expected {order}")
        for side, members, sensors in cases:
            model = thermal_field(side, side, sensors)
            _, cpu, _ = analysis(model, name, {"members": members, **options}, 2 if name == "letkf" else 3)
            n, m = side * side, sensors * sensors
            share = cpu * 1e9 / count(n, members, m)
            print(f"    n = {n:6d}, N = {members:2d}, m = {m:3d}: {cpu * 1e3:8.1f} [{share:7.3f}]")


def thermal_cycles() -> None:
    """Cycles a second with 40,000 cells and 40 members: forecast with noise, and analysis of 100 thermocouples."""
    model, cycles = thermal_field(), 12
    log = Log(model.width, cycles)
    rng = np.random.default_rng(0)
    for k in range(cycles):
        y = 20.0 + rng.standard_normal(model.width)
        log.extend(Events.one((k + 1) * 10**9, 0, READING, 0, y, model.width))
    print("Cycles of 40,000 cells, 40 members, 100 thermocouples; model included")
    for title, name, options in (("ETKF", "etkf", {}), ("EnSRF, 0.5 m", "ensrf", {"radius": 0.5})):
        fold = Fold(name, model, Tuning.of(model).with_options({"members": 40, **options}), log)
        fold.advance(2)
        clock, cpu = both(fold.advance)
        rate = (cycles - 2) / clock
        print(
            f"  {title:14s} {rate:6.1f} a second of the clock, {(cycles - 2) / cpu:6.1f} a second of the processor"
            f"   >= 10   {judged(rate, 10, at_least=True)}"
        )
