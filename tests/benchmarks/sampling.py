"""Cost of particle and ensemble filters, beside the packages `particles` and DAPPER where they are installed.

No extra can name `particles`: version 0.4 requires numpy < 2 but runs with numpy 2. Install it with
`pip install joblib scikit-learn && pip install --no-deps particles`.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numba
import numpy as np

from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models.gripper_contact import GRIPPER_CONTACT
from estimators.models.lorenz import LORENZ96
from estimators.models.thermal_field import thermal_field
from estimators.snapshots import Base
from estimators.track import USED
from estimators.tuning import Tuning
from tests.models import first_state
from tests.support import folded

from ..support import SECOND
from ..textbook import CHAOS, simulate
from .timing import BenchmarkRow, Bound, both, compare

STEPS = 20
CYCLES, THEIR_CYCLES, CYCLE_S = 400, 40, 0.05


def _f(x, u, p, dt, out):  # noqa: ANN001, ANN202
    for k in range(3):
        out[k] = 0.9 * x[k] + 0.1 * x[(k + 1) % 3] / (1.0 + x[k] * x[k])


MODEL = StateSpaceModel(
    name="three",
    title="three coupled states, the first seen",
    states=tuple(State(f"x{k}", "1") for k in range(3)),
    sensors=(Sensor("y", (Row("y", "1", 0.25),), h=first_state),),
    noises=tuple(Noise(f"x{k}", "1/s", 0.09) for k in range(3)),
    f=_f,
)


def _readings() -> np.ndarray:
    rng = np.random.default_rng(0)
    x, following, y = np.zeros(3), np.empty(3), np.empty(STEPS)
    for k in range(STEPS):
        _f(x, None, None, 1.0, following)
        x = following + 0.3 * rng.standard_normal(3)
        y[k] = x[0] + 0.5 * rng.standard_normal()
    return y


def _refolding(fold: Fold) -> Callable[[], None]:
    """Fold once, and return a call that folds again from the start."""
    fold.advance()

    def again() -> None:
        fold.rewind(0)
        fold.advance()

    return again


def _particles(name: str, n: int, model: StateSpaceModel = MODEL, middle: float = 0.0) -> Callable[[], None]:
    log = Log(model.width)
    step = min(1.0, model.max_step)
    for k, value in enumerate(_readings()):
        t = round((k + 1) * step * SECOND)
        log.extend(Events.one(t, 0, READING, 0, middle + value, model.width))
    return _refolding(Fold(name, model, Tuning.of(model).with_options({"particles": n}), log))


def _peer(n: int) -> Callable[[], object]:
    """Return a run of the package `particles`."""
    import particles
    from particles import distributions as dists
    from particles import state_space_models as ssm

    class Three(ssm.StateSpaceModel):
        def PX0(self):  # noqa: ANN202, N802
            return dists.IndepProd(*[dists.Normal()] * 3)

        def PX(self, t, xp):  # noqa: ANN001, ANN202, N802
            means = [0.9 * xp[:, k] + 0.1 * xp[:, (k + 1) % 3] / (1.0 + xp[:, k] ** 2) for k in range(3)]
            return dists.IndepProd(*[dists.Normal(loc=mean, scale=0.3) for mean in means])

        def PY(self, t, xp, x):  # noqa: ANN001, ANN202, N802
            return dists.Normal(loc=x[:, 0], scale=0.5)

    y = _readings()
    return lambda: particles.SMC(fk=ssm.Bootstrap(ssm=Three(), data=y), N=n, ESSrmin=0.5, collect="off").run()


def _wall(call: Callable[[], object]) -> float:
    """Return clock seconds per step."""
    begun = perf_counter()
    call()
    return (perf_counter() - begun) / STEPS


def beside_particles() -> Iterator[BenchmarkRow]:
    """Bootstrap particle filter, 3 states, beside the package `particles`: ms per step by the clock, interleaved."""
    threads = numba.get_num_threads()
    try:
        for n in (10**5, 10**6):
            for count in sorted({1, threads}):
                numba.set_num_threads(count)
                ours, name = _particles("pf", n), f"N={n:,} threads={count}"
                try:
                    theirs = _peer(n)
                except ImportError:
                    step = median(_wall(ours) for _ in range(5)) * 1e3
                    yield BenchmarkRow(name, {"Nisus [ms]": step}, remark="particles is not installed")
                    continue
                rounds = [(_wall(ours), _wall(theirs)) for _ in range(7 if n < 10**6 else 5)]
                a, b, ratio = (median(column) for column in zip(*[(a, b, b / a) for a, b in rounds], strict=True))
                bounds = (Bound("ratio", 3.5, at_least=True),) if count == threads else ()
                yield BenchmarkRow(name, {"Nisus [ms]": a * 1e3, "particles [ms]": b * 1e3, "ratio": ratio}, bounds)
    finally:
        numba.set_num_threads(threads)


def _cost(name: str, sizes: tuple[int, ...], *model: Any) -> BenchmarkRow:
    costs = {}
    for n in sizes:
        call = _particles(name, n, *model)
        costs[f"N={n:,}"] = median(_wall(call) for _ in range(5)) / n * 1e9
    return BenchmarkRow(name, costs)


def growing_members() -> Iterator[BenchmarkRow]:
    """Cost per particle and step of each particle filter, ns by the clock; it should not grow with N."""
    for name in ("pf", "pf-reg", "pf-ekf", "apf"):
        yield _cost(name, (1_000, 10_000, 100_000))


def rao_blackwellised() -> Iterator[BenchmarkRow]:
    """Cost per particle and step on gripper_contact, ns by the clock: a Kalman filter per particle beside sampling."""
    for name in ("pf", "rbpf"):
        yield _cost(name, (500, 5_000, 50_000), GRIPPER_CONTACT, 20.0)


def _ensemble(name: str, options: dict[str, float]) -> Callable[[], None]:
    chaos = CHAOS["lorenz96"]
    tuning = Tuning.of(LORENZ96).with_options(options).set("Q.x", 0.0)
    base = Base(chaos.mean, chaos.variance * np.eye(40), 0, np.zeros(0))
    return _refolding(Fold(name, LORENZ96, tuning, simulate(chaos, CYCLES, 1)[1], base=base))


def beside_dapper() -> Iterator[BenchmarkRow]:
    """A cycle on Lorenz 96 (40 states, all measured) beside DAPPER's with its statistics: processor time, medians."""
    import dapper
    import dapper.da_methods as da
    import dapper.tools.progressbar as progress
    from dapper.mods.Lorenz96.sakov2008 import HMM

    progress.disable_progbar = True
    dapper.set_seed(3000)
    HMM.tseq.T, HMM.tseq.BurnIn = THEIR_CYCLES * CYCLE_S, 0.0
    xx, yy = HMM.simulate()
    rows: tuple[tuple[str, str, dict[str, float], Any], ...] = (
        ("EnKF N=40", "enkf", {"members": 40, "inflation": 1.06}, da.EnKF("PertObs", N=40, infl=1.06)),
        ("ETKF N=24", "etkf", {"members": 24, "inflation": 1.02}, da.EnKF("Sqrt", N=24, infl=1.02)),
        ("EnSRF N=24", "ensrf", {"members": 24, "inflation": 1.02}, da.EnKF("Serial", N=24, infl=1.02)),
        ("LETKF N=7", "letkf", {"members": 7, "inflation": 1.07, "radius": 14.56}, da.LETKF(N=7, infl=1.07, loc_rad=4)),
        ("LETKF N=24", "letkf", {"members": 24, "inflation": 1.04, "radius": 14.56},
         da.LETKF(N=24, infl=1.04, loc_rad=4)),
    )  # fmt: skip
    for title, name, options, method in rows:

        def theirs(method: Any = method) -> None:
            method.assimilate(HMM, xx, yy, liveplots=False)

        pair = compare(_ensemble(name, options), theirs, steps=(CYCLES, THEIR_CYCLES), repetitions=7)
        figures = {"Nisus [µs]": pair.ours * 1e6, "DAPPER [µs]": pair.theirs * 1e6, "ratio": pair.ratio}
        yield BenchmarkRow(title, figures, (Bound("ratio", 10, at_least=True),))


def _peak(reset: bool = False) -> float:
    """Return the peak resident memory since the last reset, bytes (Linux)."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024.0 * float(next(line.split()[1] for line in lines if line.startswith("VmHWM")))


def analysis(model: StateSpaceModel, name: str, options: dict[str, float], repetitions: int) -> tuple[float, ...]:
    """Return clock and processor seconds of one analysis, and memory as a multiple of the ensemble."""
    log = Log(model.width, 16)
    rng, rows = np.random.default_rng(0), len(model.sensors[0].rows)
    for _ in range(repetitions + 1):
        # A different value, since a copy would be rejected as a duplicate.
        y = model.prior_mean[0] + rng.standard_normal(rows)
        log.extend(Events.one(0, 0, READING, 0, y, model.width))
    fold = folded(name, model, log, options=options, stop=1)
    gc.collect()
    peak = _peak(reset=True)
    times = [both(lambda: fold.advance(1)) for _ in range(repetitions)]
    assert np.all(fold.track.verdict[: fold.n] == USED), "an analysis was not made"
    ensemble = fold._now.state.nbytes
    memory = (ensemble + fold.machine.work.nbytes + _peak() - peak) / ensemble
    return median(t for t, _ in times), median(t for _, t in times), memory


def large_states() -> Iterator[BenchmarkRow]:
    """One analysis of a million states, 50 members (400 MB), 100 rows."""
    model = thermal_field(1000, 1000)
    rows: tuple[tuple[str, str, dict[str, float], float], ...] = (
        ("ETKF", "etkf", {"members": 50}, 0.5),
        ("EnSRF, radius 1 m", "ensrf", {"members": 50, "radius": 1.0}, 3.0),
    )
    for title, name, options, bound in rows:
        clock, cpu, memory = analysis(model, name, options, 5)
        figures = {"clock [s]": clock, "processor [s]": cpu, "memory [ensembles]": memory}
        yield BenchmarkRow(title, figures, (Bound("clock [s]", bound), Bound("memory [ensembles]", 1.3)))


def growing_ensembles() -> Iterator[BenchmarkRow]:
    """One analysis of a field against n, N and m: ms of the processor, and ns by the expected order."""
    rows: tuple[tuple[str, dict[str, float], str, Callable[[int, int, int], float]], ...] = (
        ("etkf", {}, "n N²", lambda n, members, m: n * members**2),
        ("ensrf", {"radius": 0.5}, "n N m", lambda n, members, m: n * members * m),
        # Each cell solves for the fewer of N and the rows within the radius: 78 of 100 at n = 10,000, 20 and 5 beyond.
        ("letkf", {"radius": 0.5}, "n", lambda n, members, m: n),
    )
    cases = [(side, 40, 10) for side in (100, 200, 400)] + [(200, N, 10) for N in (10, 20, 80)]
    cases += [(200, 40, sensors) for sensors in (5, 20)]
    for name, options, order, count in rows:
        for side, members, sensors in cases:
            model = thermal_field(side, side, sensors)
            _, cpu, _ = analysis(model, name, {"members": members, **options}, 2 if name == "letkf" else 3)
            n, m = side * side, sensors * sensors
            figures = {"processor [ms]": cpu * 1e3, "by order [ns]": cpu * 1e9 / count(n, members, m)}
            yield BenchmarkRow(f"{name} n={n:,} N={members} m={m}", figures, remark=f"order {order}")


def many_rows() -> Iterator[BenchmarkRow]:
    """One analysis of 40,000 states, 40 members: EnSRF with 3,969 rows beside ETKF, and LETKF with 100 rows."""
    clock, cpu, _ = analysis(thermal_field(200, 200, 63), "ensrf", {"members": 40}, 5)
    _, together, _ = analysis(thermal_field(200, 200, 63), "etkf", {"members": 40}, 5)
    figures = {"clock [ms]": clock * 1e3, "processor [ms]": cpu * 1e3, "ETKF [ms]": together * 1e3}
    yield BenchmarkRow("EnSRF m=3,969", figures | {"ratio": cpu / together}, (Bound("ratio", 3.0),))
    clock, cpu, _ = analysis(thermal_field(), "letkf", {"members": 40, "radius": 0.5}, 5)
    figures = {"clock [ms]": clock * 1e3, "processor [ms]": cpu * 1e3}
    yield BenchmarkRow("LETKF m=100, radius 0.5 m", figures, (Bound("clock [ms]", 25.0),))


def thermal_cycles() -> Iterator[BenchmarkRow]:
    """Cycles per second of 40,000 cells, 40 members, 100 thermocouples, with the model's forecast."""
    model, cycles = thermal_field(), 12
    log = Log(model.width, cycles)
    rng = np.random.default_rng(0)
    for k in range(cycles):
        y = 20.0 + rng.standard_normal(model.width)
        log.extend(Events.one((k + 1) * 10**9, 0, READING, 0, y, model.width))
    for title, name, options in (("ETKF", "etkf", {}), ("EnSRF, 0.5 m", "ensrf", {"radius": 0.5})):
        fold = folded(name, model, log, options={"members": 40, **options}, stop=2)
        clock, cpu = both(fold.advance)
        figures = {"per clock s": (cycles - 2) / clock, "per processor s": (cycles - 2) / cpu}
        yield BenchmarkRow(title, figures, (Bound("per clock s", 10, at_least=True),))
