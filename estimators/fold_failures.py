"""Find the model function that causes a failed measurement, or a fold that does not return."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from .diagnostics.failure_cause import Estimate, around, cause, failures, questions
from .fold import Fold
from .fold_machine import variances_of
from .interpreted.fold_loop import MAX_PREDICT_STEPS, UNSET
from .log import INPUT, READING


def cause_of(fold: Fold, row: int) -> str | None:
    """Return, in one line, the cause in the model of a failed measurement or an estimate of NaN; None if none is found.

    Evaluates the model from the last finite estimate before the row, which takes milliseconds.
    """
    if fold.failure is not None:
        return str(fold.failure)
    log, track, model = fold.log, fold.track, fold.model
    known = np.setdiff1d(np.arange(row), failures(track))
    last = int(known[-1]) if known.size else -1
    at, base = fold.base_at(max(0, last))
    x, u, then = base.mean.copy(), base.u.copy(), base.clock
    std = np.sqrt(variances_of(base.cov))
    if known.size:
        x[model.shown], std[model.shown], then = track.mean[last], track.std[last], int(log.t[last])
    for k in at + np.flatnonzero(log.kind[at:row] == INPUT):
        given = log.value[k, : u.size]
        np.copyto(u, given, where=np.isfinite(given))
    dt = (int(log.t[row]) - then) * 1e-9 if then != UNSET else 0.0
    if dt > MAX_PREDICT_STEPS * model.max_step:
        mean, cov = fold.prior
        x, std, dt = mean.copy(), np.sqrt(variances_of(cov)), 0.0
    sensor = int(log.channel[row]) if log.kind[row] == READING else None
    predicted = None
    if len(model.shown) == model.nx and np.all(np.isfinite(track.mean[row]) & np.isfinite(track.std[row])):
        predicted = Estimate(track.mean[row].copy(), track.std[row])
    held = fold.machine.held
    return cause(fold.compiled, Estimate(x, std), u, held["p"], held["q"], dt, sensor, predicted)


def questions_of(fold: Fold) -> Iterator[tuple[str, Callable[[], object]]]:
    """Return calls of the model that a fold running in another thread probably makes, to be tried one by one.

    Each function at the filter's points, its mean and around it; none for a black box.
    """
    if fold.compiled.box is not None or fold.n >= fold.log.n:
        return iter(())
    mean, cov = fold.moments()
    std = np.sqrt(np.maximum(variances_of(cov), 0.0))
    states = [mean, *fold.points(), *around(fold.compiled, Estimate(mean, std))]
    finite = [np.ascontiguousarray(x) for x in states if x.size == mean.size and np.all(np.isfinite(x))]
    later, then = fold.log.t[fold.n : fold.log.n], fold.clock
    ahead = later[later > then]
    dt = (int(ahead[0]) - then) * 1e-9 if ahead.size and then != UNSET else 0.0
    # The fold crosses the time in equal steps of at most `max_step`.
    dt /= max(1, int(np.ceil(dt / fold.model.max_step)))
    return questions(fold.compiled, finite, fold.u, fold.machine.held["p"], fold.machine.held["q"], dt)
