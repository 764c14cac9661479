"""The status: what a panel shows of a running twin, put together from its fold and from all that watches it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estimators.diagnostics.detector_state import sensor_states
from estimators.diagnostics.health import MAX_ROWS_PER_READING
from estimators.diagnostics.score import nis_verdict
from estimators.fold import Fold
from estimators.log import RESET, model_version_at
from estimators.model.state_space import StateSpaceModel
from estimators.registry import find_estimator
from estimators.track import FAILED, GATED, USED
from sources.source import Source

from .counts import RowCounts, last_run
from .execute import playback_status
from .faults import Faulty
from .outputs import Status
from .watchers import Watchers

if TYPE_CHECKING:
    from estimators.tuning import Tuning

FOLDED = "the readings that came so far are being folded"
"""Why there is no row yet."""


class Asked(NamedTuple):
    """What of a status needs no look at the fold.

    `estimator` and `tuning` are those that are asked for, others than the fold's while a refold is waited for
    (`refolding`); `finished` says whether the source has ended, `recording` is the file that is being written,
    `awaited` the filter for whose compiling a refold waits, `compiling` see `Status`.
    """

    estimator: str
    tuning: Tuning
    refolding: bool
    finished: bool
    recording: Path | None
    awaited: str | None
    compiling: Mapping[str, float | None]

    def fields(self, model: StateSpaceModel, source: Source) -> dict[str, Any]:
        """These and what follows from them and from the source, as fields of a status."""
        options = find_estimator(self.estimator, model).complete(dict(self.tuning.options))
        return {**self._asdict(), "options": options, **playback_status(source)}


def kept_status(kept: Status, asked: Asked, model: StateSpaceModel, source: Source, busy: float) -> Status:
    """The last status of a fold that has been at work for `busy` seconds, with what is known without it."""
    fields = asked.fields(model, source)
    if kept.t is None and busy >= 1.0 and asked.awaited is None:
        fields["cause"] = f"{FOLDED} ({busy:.0f} s so far)"
    return replace(kept, **fields)


def status_of(
    fold: Fold,
    rows: RowCounts,
    watchers: Watchers,
    source: Source,
    asked: Asked,
    *,
    revision: int,
    inflated: int,
    held: int,
    notices: Mapping[str, int],
) -> Status:
    """The status of a fold that stands still meanwhile.

    Args:
        fold: The running one.
        rows: Counts of its rows.
        watchers: What they found.
        source: Of its readings.
        asked: What is known without it.
        revision: Its number.
        inflated: Late readings whose noise was inflated.
        held: Events that wait for the next to tell whether their time is true.
        notices: Counts of what was said.
    """
    model, log, track = fold.model, fold.log, fold.track
    last = fold.n - 1
    now = log.t[last] * 1e-9 if last >= 0 else 0.0
    states = sensor_states(model, fold.tuning.used, fold.evidence, now, fold.policy)
    health = int(track.health[last]) if last >= 0 else watchers.silence.health
    account = watchers.chronicle.account
    leading = account.leading(dict(zip(model.sensor_names, states, strict=True)))
    layer = source.faults if isinstance(source, Faulty) else None
    silenced, recovered = layer.lost if layer is not None else 0, fold.recoveries()
    return Status(
        **asked.fields(model, source),
        revision=revision,
        t=int(log.t[last]) if last >= 0 else None,
        health=health,
        since=int(log.t[last_run(track.health)]) if last >= 0 else None,
        cause=watchers.cause(leading, health) if last >= 0 else _before(fold, watchers, asked),
        sensors=account.of_sensors(model.sensor_names, states),
        episodes_open=len(account.lasting),
        lost=watchers.alerts.lost,
        model_version=model_version_at(log, int(log.t[last])) if last >= 0 else log.version,
        clock=watchers.clock.estimate,
        counts={
            **notices,
            **({"inflated": inflated} if inflated else {}),
            **({"held": held} if held else {}),
            **rows.count(track, log.channel),
            **({"recovered": recovered} if recovered else {}),
            **({"silenced": silenced} if silenced else {}),
        },
        account=fold.account(),
        nis=float(track.nis_mean[last]) if last >= 0 else np.nan,
        nis_low=float(track.nis_low[last]) if last >= 0 else np.nan,
        nis_high=float(track.nis_high[last]) if last >= 0 else np.nan,
        nis_judged=_judged(fold),
        latency_ms=watchers.latency.percentile(99.0),
        latency_p50_ms=watchers.latency.percentile(50.0),
        integrity=watchers.integrity.of(revision),
        faults=layer.status() if layer is not None else (),
    )


def _judged(fold: Fold) -> float:
    """Of a commissioned twin the NIS of the readings in the window, as it is compared with what was normal."""
    baseline, n, window = fold.tuning.baseline, fold.n, fold.policy.window
    if baseline is None:
        return np.nan
    rows = slice(max(0, n - MAX_ROWS_PER_READING * window), n)
    resets = np.flatnonzero(fold.log.kind[rows] == RESET)
    begun = rows.start + (int(resets[-1]) + 1 if resets.size else 0)
    judged = begun + np.flatnonzero(np.isin(fold.track.verdict[begun:n], (USED, GATED, FAILED)))[-window:]
    events, track = fold.log.events.select(judged), fold.track.select(judged)
    return nis_verdict(track, events, fold.model, baseline).judged


def _before(fold: Fold, watchers: Watchers, asked: Asked) -> str:
    """Why there is no row."""
    if fold.idle and asked.awaited is not None:
        begun = asked.compiling.get(asked.awaited)
        since = f" ({begun:.0f} s so far)" if begun else ""
        return f"{asked.awaited} is being compiled, which happens once{since}; readings are kept meanwhile"
    if fold.idle:
        return FOLDED
    return watchers.silence.cause
