"""The fold's loop in Python, for filters that are not compiled: the same events, rows and order as fold_kernel.py.

The filter is four Python functions instead of addresses (see estimator.py), and the context is a `View`. Snapshots and
rewinds are those of `Fold`.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np

from ..compiled.context import steps_of
from ..compiled.verdict import limit_of
from ..errors import ModelError
from ..estimator import Code
from ..gate.rejection_runs import Rule, forget, note
from ..gate.soften import inflation
from ..log import INPUT, MARK, READING, RESET, TICK, TRUTH
from ..plausibility import pass_on, screen_reading
from ..snapshots import Snapshot
from ..track import ANCESTORS, EFFECTIVE, FAILED, GATED, LOG_LIKELIHOOD, MISSING, NONE, SCREENED, USED, WHITENED, Track
from .view import View

UNSET = int(np.iinfo(np.int64).min)
"""Clock before the first event. The first event sets it, as the prior holds at that time."""

MAX_PREDICT_STEPS = 10_000
"""Largest number of prediction steps between two events, so that a jump of the clock does not stall the fold."""


def begin(code: Code, context: View, mean: np.ndarray, cov: np.ndarray, state: np.ndarray) -> None:
    """Set the state to N(mean, cov)."""
    with np.errstate(all="ignore"):
        code.start(context, mean, cov, state)


def _advance_to(
    code: Code, context: View, u: np.ndarray, clock: np.ndarray, t: int, index: int, state: np.ndarray, work: np.ndarray
) -> None:
    """Predict to time t; if the model fails, state and clock stay at the last step that succeeded."""
    begun = int(clock[0])
    if begun != UNSET and t > begun:
        dt = (t - begun) * 1e-9
        if dt > MAX_PREDICT_STEPS * context.max_step:
            code.start(context, *context.prior, state)
        else:
            steps = steps_of(dt, context.max_step)
            for k in range(steps):
                code.predict(context, u, dt / steps, index, state, work)
                clock[0] = begun + round((k + 1) * (t - begun) / steps)
    clock[0] = t


def run(
    code: Code,
    context: View,
    rule: Rule,
    first: int,
    start: int,
    end: int,
    t: np.ndarray,
    kind: np.ndarray,
    channel: np.ndarray,
    value: np.ndarray,
    width: int,
    clock: np.ndarray,
    u: np.ndarray,
    state: np.ndarray,
    doubt: np.ndarray,
    edge: np.ndarray,
    spare: np.ndarray,
    work: np.ndarray,
    score: np.ndarray,
    track: Track,
) -> int:
    """Fold events `start` to `end`; see `fold_kernel.run`.

    If the model's Python raises, the view counts it and the fold continues: the measurement has the verdict failed, an
    estimate that needs the result is NaN, and state and clock are unchanged for the next event. Filters evaluate the
    model before they change their state, so that the state is never half updated.
    """
    tuned = nullcontext()
    passed = np.empty(value.shape[1])
    with np.errstate(all="ignore"):  # as compiled code: a number that is not finite is an answer, not a warning
        for i in range(start, end):
            what, now, index = int(kind[i]), int(t[i]), first + i
            track.screened[i] = 0
            track.innovation[i] = np.nan
            track.innovation_std[i] = np.nan
            score[:] = np.nan
            score[1] = 0.0
            track.flags[i] = 0
            track.factor[i] = 1.0
            verdict = NONE
            asked = False
            told = state
            known = True
            if what in (READING, INPUT):
                if what == READING:
                    sensor = int(channel[i])
                    refused = screen_reading(i, now, sensor, value[i], context.context, edge, track.screened)
                    given = passed if refused else value[i]
                try:
                    known = False
                    _advance_to(code, context, u, clock, now, index, state, work)
                    known = True
                    if what == READING:
                        innovation, innovation_std = track.innovation[i], track.innovation_std[i]
                        if refused and not pass_on(value, track.screened, i, passed):
                            verdict = SCREENED
                        else:
                            with context.brought(sensor, value[i, width:]) if value.shape[1] > width else tuned:
                                told_of = context, u, sensor, given, index, state, work
                                scored = innovation, innovation_std, score
                                verdict = code.update(*told_of, *scored)
                                if verdict == GATED and rule.soft:
                                    verdict = _soften(code, told_of, *scored)
                        if verdict in (GATED, USED):
                            beyond = score[0] > limit_of(context.context, sensor, int(score[1]))
                            asked = note(doubt[sensor], rule.most, beyond, index, float(now))
                except ModelError as error:
                    context.failed(error)
                    verdict = FAILED if what == READING else NONE
                if what == INPUT:
                    given = value[i, : u.size]
                    np.copyto(u, given, where=np.isfinite(given))
            elif what == RESET:
                code.start(context, *context.prior, state)
                forget(doubt)
                clock[0] = now
            else:
                if clock[0] == UNSET:
                    clock[0] = now
                # Several queries at one time are one: `spare` still holds the answer.
                if i == start or kind[i - 1] not in (TRUTH, TICK, MARK) or now != t[i - 1]:
                    spare[:] = state
                    try:
                        _advance_to(code, context, u, clock.copy(), now, index, spare, work)
                    except ModelError as error:
                        context.failed(error)
                        spare[:] = np.nan
                told = spare
            code.describe(context, told, track.mean[i], track.std[i], track.cross[i])
            if not known:
                track.mean[i], track.std[i], track.cross[i] = np.nan, np.nan, np.nan
            track.nis[i] = score[0] if verdict != MISSING else np.nan
            track.dof[i] = int(score[1])
            track.log_likelihood[i] = score[2]
            track.verdict[i] = verdict
            track.effective[i] = score[EFFECTIVE]
            track.ancestors[i] = score[ANCESTORS]
            track.whitened[i] = score[WHITENED:]
            if asked:
                return i
    return -1


def _soften(
    code: Any, given: tuple[Any, ...], innovation: np.ndarray, innovation_std: np.ndarray, score: np.ndarray
) -> int:
    """Update with inflated noise; see gate/soften.py."""
    context, _, sensor, y, *_ = given
    w = inflation(context.context, sensor, y, innovation, score[0], int(score[1]))
    if not w < np.inf:
        return GATED
    nu, std, scored = innovation.copy(), innovation_std.copy(), score.copy()
    with context.brought(sensor, w * context.r[sensor]):
        verdict = int(code.update(*given, innovation, innovation_std, score))
    innovation[:], innovation_std[:] = nu, std
    if verdict == USED:
        scored[LOG_LIKELIHOOD] = score[LOG_LIKELIHOOD]
    score[:] = scored
    return verdict


def run_and_judge(judge: Any, context: View, code: Code, place: int, *given: Any) -> int:
    """Fold events, and fill NIS windows, alarms and health of their rows; see `fold_kernel.run_and_judge`.

    `judge` is the compiled function there, `context` a `View` in place of the context at the address. The last argument
    lists snapshots to fill in place of their addresses.
    """
    rule, first, start, stops, *rest, policy, bounds, evidence, kept = given
    t, kind, channel, value, _, clock, u, state, doubt, edge, _, _, _, track = rest
    for k, stop in enumerate(stops.tolist()):
        asking = run(code, context, rule, first, start, stop, *rest)
        end = stop if asking < 0 else asking + 1
        if policy.window > 0:
            judge(start, end, t, kind, channel, value, context.context, policy, bounds, evidence, track)
        if asking >= 0:
            return asking
        if k < len(kept):
            kept[k].copy_from(Snapshot(clock, u, state, evidence, edge, doubt))
        start = end
    return -1
