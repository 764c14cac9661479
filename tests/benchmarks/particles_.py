"""What a step of the particle filters costs, beside the package `particles` where it is installed.

No extra can name it: version 0.4 asks for numpy < 2, though it runs with numpy 2. So:
`pip install joblib scikit-learn && pip install --no-deps particles`.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter

import numba
import numpy as np

from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models.gripper_contact import GRIPPER_CONTACT
from estimators.tuning import Tuning

from ..support import SECOND
from .timing import judged

STEPS = 20


def _f(x, u, p, dt, out):  # noqa: ANN001, ANN202
    for k in range(3):
        out[k] = 0.9 * x[k] + 0.1 * x[(k + 1) % 3] / (1.0 + x[k] * x[k])


def _h(x, u, p, out):  # noqa: ANN001, ANN202
    out[0] = x[0]


MODEL = StateSpaceModel(
    name="three",
    title="three coupled states, the first seen",
    states=tuple(State(f"x{k}", "1") for k in range(3)),
    sensors=(Sensor("y", (Row("y", "1", 0.25),), h=_h),),
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


def _ours(name: str, n: int, model: StateSpaceModel = MODEL, middle: float = 0.0) -> Callable[[], object]:
    log = Log(model.width)
    step = min(1.0, model.max_step)
    for k, value in enumerate(_readings()):
        t = round((k + 1) * step * SECOND)
        log.extend(Events.one(t, 0, READING, 0, middle + value, model.width))
    growing = Fold(name, model, Tuning.of(model).with_options({"particles": n}), log)
    growing.advance()

    def again() -> None:
        growing.rewind(0)
        growing.advance()

    return again


def _theirs(n: int) -> Callable[[], object] | None:
    try:
        import particles
        from particles import distributions as dists
        from particles import state_space_models as ssm
    except ImportError:
        return None

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
    begun = perf_counter()
    call()
    return (perf_counter() - begun) / STEPS


def beside_particles() -> None:
    """Bootstrap with systematic resampling below half of N, 3 states, one sensor; seconds of the clock."""
    print("bootstrap particle filter, 3 states, against the package particles (pairs A B A B, medians, clock)")
    if _theirs(10) is None:
        print("  particles is not installed (see the head of tests/benchmarks/particles_.py); ours alone")
    threads = numba.get_num_threads()
    for n in (10**5, 10**6):
        theirs = _theirs(n)
        for count in sorted({1, threads}):
            numba.set_num_threads(count)
            ours = _ours("pf", n)
            rounds = [(_wall(ours), _wall(theirs) if theirs else np.nan) for _ in range(7 if n < 10**6 else 5)]
            a, b, ratio = (median(column) for column in zip(*[(a, b, b / a) for a, b in rounds], strict=True))
            line = f"  N = {n:>9,d}, {count} thread{'s' if count > 1 else ' '}: {a * 1e3:8.2f} ms a step"
            if theirs:
                line += f", theirs {b * 1e3:8.2f} ms, ratio {ratio:5.1f}"
                line += f"  {judged(ratio, 3.5, at_least=True)} (at least 3.5)" if count == threads else ""
            print(line)
    numba.set_num_threads(threads)


def growing_members() -> None:
    """Cost a particle of each particle filter as N grows; it should stay the same."""
    print("cost a particle and step, ns (clock), as N grows")
    for name in ("pf", "pf-reg", "pf-ekf", "apf"):
        costs = []
        for n in (1_000, 10_000, 100_000):
            call = _ours(name, n)
            costs.append(f"N = {n:,d}: {median(_wall(call) for _ in range(5)) / n * 1e9:6.0f}")
        print(f"  {name:7s} {'   '.join(costs)}")


def rao_blackwellised() -> None:
    """`rbpf` beside `pf` on the gripper: a Kalman filter of three states a particle against five states sampled."""
    print("cost a particle and step on gripper_contact, ns (clock), as N grows")
    for name in ("pf", "rbpf"):
        costs = []
        for n in (500, 5_000, 50_000):
            call = _ours(name, n, GRIPPER_CONTACT, 20.0)
            costs.append(f"N = {n:,d}: {median(_wall(call) for _ in range(5)) / n * 1e9:6.0f}")
        print(f"  {name:7s} {'   '.join(costs)}")
