"""What the defences cost: screen, gate's account and the bank of tests, beside the same fold without them."""

from __future__ import annotations

from functools import lru_cache, partial
from types import FunctionType
from typing import Any

import numpy as np

from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators import fold_kernel
from estimators.diagnostics.health import NORMALS, assess
from estimators.fold import Fold
from estimators.log import Log
from estimators.models import MODELS
from estimators.numerics.jit import floats, jit_brief
from estimators.tuning import Tuning

from .filters import STEPS, noisy_log
from .timing import judged, seconds

MOST = 2.0
"""Times a bare fold that all defences together may cost."""

CASES = (("motor_can", "ekf"), ("motor_can", "ukf"), ("road_car", "ekf"), ("motor_can", "pf"))
PARTICLES_EVENTS = 1000
REPETITIONS = 9


@jit_brief
def _nothing_to_refuse(i, now, s, y, context, state, screened):
    return False


@jit_brief
def _nothing_to_note(doubt, most, beyond, index, t):
    return False


@lru_cache(maxsize=1)
def bare_kernel() -> Any:
    """The fold's own loop, of the same source, that calls neither screen nor account of refusals; then the NIS windows.

    What is left is predict, update, describe, NIS and its window: what a filter has to say without any defence.
    """
    own = {**fold_kernel.__dict__, "screen_reading": _nothing_to_refuse, "note": _nothing_to_note}
    loop = jit_brief(cache=False)(FunctionType(fold_kernel.run.py_func.__code__, own, "run"))

    @jit_brief(cache=False)
    def kernel(
        code, context, rule, first, start, end, t, kind, channel, value, width,
        clock, u, state, doubt, edge, spare, work, score, track, policy, bounds, evidence,
    ):  # fmt: skip
        loop(
            code, context, rule, first, start, end, t, kind, channel, value, width,
            clock, u, state, doubt, edge, spare, work, score, track,
        )  # fmt: skip
        normal = floats(context.normal, NORMALS * context.n_sensors)
        assess(start, end, t, kind, channel, track, normal, policy, bounds)
        return -1

    kernel.compile(fold_kernel.run_signature.args)
    return kernel


def _pair(estimator: str, model: Any, tuning: Tuning, log: Log) -> tuple[Fold, Fold]:
    defended, bare = (Fold(estimator, model, tuning, log) for _ in range(2))
    bare._machine._run = bare_kernel()
    return defended, bare


def _again(growing: Fold) -> None:
    growing.rewind(0)
    growing.advance()


def defences() -> None:
    """Minima of processor time, one after the other in turn: a neighbour can only lengthen either."""
    print("Defences: µs an event of a fold with all of them, of a bare one, and the ratio")
    print(f"  {'twin':15s} {'filter':6s} {'events':>8s} {'all':>9s} {'bare':>9s} {'ratio':>7s}")
    winding = MODELS["motor_winding"]
    rows = [("motor_winding", "kf", winding, Tuning.of(winding), noisy_log(winding, STEPS))]
    for name, estimator in CASES:
        twin = load_twin(name)
        log, _ = read_log(twin, None)
        if estimator == "pf":
            log.n = min(log.n, PARTICLES_EVENTS)
        tuning = twin.tuning if estimator == twin.estimator else twin.tuning.with_options({})
        rows.append((name, estimator, twin.model, tuning, log))
    for name, estimator, model, tuning, log in rows:
        folds = _pair(estimator, model, tuning, log)
        times = np.array([[seconds(partial(_again, fold)) for fold in folds] for _ in range(REPETITIONS)])
        least = times[1:].min(axis=0) / log.n * 1e6
        ratio = least[0] / least[1]
        print(
            f"  {name:15s} {estimator:6s} {log.n:8,d} {least[0]:9.3f} {least[1]:9.3f} {ratio:7.2f}"
            f"   <= {MOST:g}   {judged(ratio, MOST, at_least=False)}",
            flush=True,
        )
