"""The status of a running twin, from its fold and its watchers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from estimators.diagnostics.consistency import NisVerdict
from estimators.diagnostics.detector_state import sensor_states
from estimators.diagnostics.health import MAX_ROWS_PER_READING, HealthPolicy
from estimators.diagnostics.references import own_grades
from estimators.diagnostics.score import nis_verdict
from estimators.fold import Fold
from estimators.log import INPUT, RESET, Events, model_version_at
from estimators.model.state_space import LARGE
from estimators.track import FAILED, GATED, USED, Track, estimated_rows
from estimators.tuning import Tuning
from sources.source import Source

from ..leading import leading, states_of_rows
from .copies import Status
from .counts import RowCounts, last_run
from .faults import Faulty
from .running_fold import Running
from .watchers import Watchers

FOLDING_CAUSE = "the measurements so far are being folded"
"""Cause of a twin without a row yet."""

WINDOW_REACH = 2 * MAX_ROWS_PER_READING  # Rows per measurement of the window: also those after its last measurement
Known: TypeAlias = Mapping[str, Any]  # Fields of a status that are known without the fold
SINCE_ROWS = 4096  # Rows copied at once in search of the beginning of a health


def busy_status(last: Status, fields: Known, busy: float) -> Status:
    """Return the last status of a fold that has been at work for `busy` seconds, with the present known fields."""
    if last.t is None and busy >= 1.0 and fields["awaited"] is None:
        fields = {**fields, "cause": f"{FOLDING_CAUSE} ({busy:.0f} s so far)"}
    # It has not ended before its last rows are told.
    return replace(last, **{**fields, "finished": fields["finished"] and last.finished})


def status_of(
    fold: Fold,
    rows: RowCounts,
    watchers: Watchers,
    source: Source,
    fields: Known,
    notices: Mapping[str, int],
    late: Mapping[str, int],
) -> Status:
    """Return the status of a fold that does not change meanwhile.

    `fields` are those that are known without the fold, and the revision; `notices` has counts of notices by key, `late`
    those of measurements whose time is late or in doubt.
    """
    model, log, track = fold.model, fold.log, fold.track
    recent = slice(max(0, fold.n - WINDOW_REACH * fold.policy.window), fold.n)
    nis = _nis_of_window(fold.tuning, fold.policy, log.events.select(recent), track.select(recent))
    last = fold.n - 1
    t = int(log.t[last]) if last >= 0 else None
    states = sensor_states(model, fold.tuning.used, fold.evidence, (t or 0) * 1e-9, fold.policy)
    health = int(track.health[last]) if last >= 0 else watchers.silence.health
    account = watchers.episode_log.summary
    layer = source.faults if isinstance(source, Faulty) else None
    optional = {**late, "recovered": fold.recoveries()}
    columns = track.mean, track.std
    mean, std = (column[last].copy() if last >= 0 else np.full(column.shape[1], np.nan) for column in columns)
    return Status(
        **fields,
        t=t,
        health=health,
        since=int(log.t[last_run(track.health)]) if last >= 0 else None,
        cause=watchers.cause(*leading(model, account.open, states, track, fold.u))
        if last >= 0
        else _cause_without_rows(fold, watchers, fields),
        sensors=account.of_sensors(states),
        episodes_open=len(account.lasting),
        lost=watchers.alerts.lost,
        model_version=log.version if t is None else model_version_at(log, t),
        clock=watchers.clock.estimate,
        counts={
            **notices,
            **rows.count(track, log.channel),
            **{name: count for name, count in optional.items() if count},
            **({"silenced": layer.lost} if layer is not None and layer.lost else {}),
        },
        account=fold.account(),
        nis=nis,
        sensor_nis=_nis_of_sensors(fold.events, track, len(model.sensors)),
        grades=own_grades(model, track, fold.u) if last >= 0 else {},
        latency_ms=watchers.latency.percentile(99.0),
        integrity=watchers.integrity.of(fields["revision"]),
        faults=layer.status() if layer is not None else (),
        sensor_rows=rows.by_sensor,
        mean=mean,
        std=std,
        inputs=fold.u.copy(),
    )


RECENT_READINGS = 8
"""Measurements of each sensor, on average, of which its NIS is the mean."""


def _nis_of_sensors(events: Events, track: Track, sensors: int) -> np.ndarray:
    """Return the mean NIS per degree of freedom of each sensor's last measurements among these, NaN without any."""
    rows = slice(max(0, len(events) - RECENT_READINGS * sensors), len(events))
    nis, dof, channel = track.nis[rows], track.dof[rows], events.channel[rows]
    judged = np.flatnonzero(np.isin(track.verdict[rows], (USED, GATED, FAILED)) & np.isfinite(nis))
    total, degrees = (np.bincount(channel[judged], of[judged], sensors) for of in (nis, dof))
    return np.divide(total, degrees, out=np.full(sensors, np.nan), where=degrees > 0)


def past_status(engine: Running, watchers: Watchers, t: int) -> Status:
    """Return the status with health, sensors, episodes and NIS after the last event at or before a time, ns.

    What does not belong to a time (counts, tuning, recording) is the present one.
    """
    status, model, policy = engine.status(), engine.model, engine.policy
    # A step of a large field takes tens of milliseconds: there sensors are as their rows show them.
    fold = engine.fold_until(t) if model.nx <= LARGE else None
    if fold is None and (model.nx <= LARGE or status.t is None):
        return status
    end = max(1, engine.index_at(t + 1)) if fold is None else fold.log.first + fold.n
    tuning = engine.folded_with()[0] if fold is None else fold.tuning
    sensors = len(model.sensors)
    # A fold from a snapshot lacks the earlier rows of its window.
    pull = engine.rows(end - max(WINDOW_REACH * policy.window, RECENT_READINGS * sensors), end)
    if not len(pull.events):
        return status
    now = int(pull.events.t[-1])
    sensor_nis = _nis_of_sensors(pull.events, pull.track, sensors)
    track, health = pull.track, int(pull.track.health[-1])
    nis = _nis_of_window(tuning, policy, pull.events, track)
    if fold is None:
        states = states_of_rows(model, tuning.used, pull.events, track)
        told = pull.events.value[pull.events.kind == INPUT, : model.nu].T
        known = [row[np.isfinite(row)] for row in told]
        inputs = np.array(
            [row[-1] if row.size else item.default for row, item in zip(known, model.inputs, strict=True)]
        )
    else:
        inputs = fold.u
        states = sensor_states(model, tuning.used, fold.evidence, now * 1e-9, policy)
    since = now
    while len(pull.events) and int(pull.track.health[-1]) == health:
        begun = last_run(pull.track.health)
        since = int(pull.events.t[begun])
        pull = engine.rows(pull.first - SINCE_ROWS, pull.first if not begun else 0)
    account = watchers.episode_log.summary.at(now * 1e-9)
    return replace(
        status,
        t=now,
        health=health,
        since=since,
        cause=watchers.cause(*leading(model, account.open, states, track, inputs), past=True),
        sensors=account.of_sensors(states),
        episodes_open=len(account.lasting),
        lost=None if estimated_rows(track.select(slice(-1, None)))[0] else now,
        nis=nis,
        grades=own_grades(model, track, inputs),
        sensor_nis=sensor_nis,
        mean=track.mean[-1].copy(),
        std=track.std[-1].copy(),
        inputs=inputs,
    )


def _nis_of_window(tuning: Tuning, policy: HealthPolicy, events: Events, track: Track) -> NisVerdict:
    """Return the verdict on the mean NIS of the last window.

    The events and their rows are the last ones, at least those of the window, which ends with the last measurement, as
    in the track.
    """
    resets = np.flatnonzero(events.kind == RESET)
    begun = int(resets[-1]) + 1 if resets.size else 0
    judged = begun + np.flatnonzero(np.isin(track.verdict[begun:], (USED, GATED, FAILED)))
    judged = judged[judged > judged[-1:] - MAX_ROWS_PER_READING * policy.window][-policy.window :]
    return nis_verdict(track.select(judged), events.select(judged), tuning.model, tuning.baseline)


def _cause_without_rows(fold: Fold, watchers: Watchers, fields: Known) -> str:
    awaited = fields["awaited"]
    if fold.idle and awaited is not None:
        begun = fields["compiling"].get(awaited)
        since = f" ({begun:.0f} s so far)" if begun else ""
        return f"{awaited} is being compiled, which happens once{since}; measurements are kept meanwhile"
    return FOLDING_CAUSE if fold.idle else watchers.silence.cause
