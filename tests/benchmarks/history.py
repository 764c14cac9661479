"""What history costs: the fold of longer logs, one more event at their end, a late one, and a slider's refold."""

from __future__ import annotations

import numpy as np

from app.studies.stress.scenario import plain_log
from app.twin.twin import load_twin
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.models import MODELS
from estimators.tuning import Tuning

from ..support import SECOND
from .filters import noisy_log
from .timing import both, judged, medians

REFOLD_READINGS = 100_000
REFOLD_BOUND = 0.2
DEFAULT_TWIN = "motor_can"


def growing_history() -> None:
    """Per event, so a flat column is what is wanted."""
    model = MODELS["motor_winding"]
    tuning = Tuning.of(model)
    print("History (KF n=2 m=1): µs an event of the whole fold, of one event appended, of one reading 100 events late")
    print(f"  {'events':>9s} {'fold':>9s} {'append':>9s} {'late':>9s}")
    for size in (1_000, 10_000, 100_000, 1_000_000):
        # Room for what is appended, so that the one growth of the arrays is not in the measure.
        log = Log.of(model, capacity=size + 4096)
        log.extend(noisy_log(model, size).events)
        growing = Fold("kf", model, tuning, log)
        growing.advance()

        def fold(growing=growing) -> None:
            growing.rewind(0)
            growing.advance()

        def event(t: int) -> Events:
            return Events.one(t, t, READING, 0, 35.0, 1)

        def append(log=log, growing=growing) -> None:
            log.extend(event(int(log.t[log.n - 1]) + SECOND))
            growing.advance()

        def late(log=log, growing=growing) -> None:
            start, _ = log.extend(event(int(log.t[log.n - 100]) + 1))
            growing.rewind(start)
            growing.advance()

        (whole,) = medians([fold], 5 if size < 1_000_000 else 3)
        one, after = medians([append, late], 301)
        print(f"  {size:9,d} {whole / size * 1e6:9.3f} {one * 1e6:9.1f} {after * 1e6:9.1f}")


def told(twin, readings: int) -> Log:
    """What the twin's asset says, without an end, until there are enough readings.

    Its recording over and over would jump from its end to its beginning, and the gate would tell two stories there.
    """
    duration = 60.0
    while np.count_nonzero((events := plain_log(twin, 0, duration)).kind == READING) < readings:
        duration *= 2.0
    enough = int(np.searchsorted(np.cumsum(events.kind == READING), readings)) + 1
    log = Log.of(twin.model, capacity=enough)
    log.extend(events.select(slice(0, enough)))
    return log


def refold() -> None:
    """A slider moved: the history folded again from its start, for the default twin and every estimator that fits."""
    twin = load_twin(DEFAULT_TWIN)
    log = told(twin, REFOLD_READINGS)
    print(
        f"Refold of {REFOLD_READINGS:,} readings ({log.n:,} events with inputs and truths) of {DEFAULT_TWIN}, seconds"
    )
    for name in ("ekf", "ukf"):
        times = []
        for k in range(5):
            tuning = twin.tuning.set(twin.tuning.items()[0].key, 0.01 + 0.001 * k)

            def slider(name=name, tuning=tuning) -> None:
                Fold(name, twin.model, tuning, log, pairs=twin.pairs).advance()

            times.append(both(slider))
        value, processor = np.median(times[1:], axis=0)
        default = name == twin.estimator
        verdict = f"<= {REFOLD_BOUND}   {judged(value, REFOLD_BOUND, at_least=False)}" if default else "   -"
        print(f"  {name:15s} {value:9.3f}   {verdict}   (processor {processor:.3f})")
