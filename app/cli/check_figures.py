"""What `nisus check` says, as JSON for a script."""

from __future__ import annotations

from typing import Any

import numpy as np

from estimators.diagnostics.calibration import BANDS
from estimators.diagnostics.episodes import episode_json
from estimators.diagnostics.sensitivity import Sensitivity, View, bounds_of
from estimators.track import HEALTH_NAMES

from ..present.result import plain
from ..studies.fold_result import calibration_json
from .check_list import blamed, checklist, stamps
from .checked import Checked


def figures(checked: Checked) -> dict[str, Any]:
    """All figures of a check; times in seconds of the log, null where there is no number.

    `checklist`: question, answer (yes, partly, no, not told), figures, remedy. `observability`: the Gramian of the log
    and of each window, and whose estimates take the blame for each other. `smallest_visible`: of every sensor row,
    input and parameter the size from which a fault is seen, null if it cannot be within its range, `low` to `high` what
    passes unseen. `integrity`: by state the bound of its error under one unseen fault beside 2 σ, and the fault.
    `held_out`: by sensor row what the others predict of it. `open_loop`: RMS without any reading, by sensor row and by
    state whose truth is known, `worse` where the filter is.
    """
    return {
        "twin": checked.twin.name,
        "estimator": checked.twin.estimator,
        "span": checked.span,
        "checklist": {line.key: line._asdict() for line in checklist(checked)},
        "observability": _observability(checked),
        "smallest_visible": smallest_visible(checked.sensitivity),
        "integrity": _integrity(checked),
        "held_out": _held_out(checked),
        "open_loop": _open_loop(checked),
        "timing": _timing(checked),
        "calibration": [calibration_json(entry) for entry in checked.calibration],
        "posterior": _posterior(checked),
        "linearity": _linearity(checked),
        "dimension": plain(checked.dimension._asdict()),
        "health": _health(checked),
    }


def _observability(checked: Checked) -> dict[str, Any]:
    found, told = checked.gramian, checked.sensitivity
    return {
        "estimator": found.estimator,
        "reason": found.reason,
        "note": found.note,
        "whole": None if found.whole is None else _view(checked, found.whole),
        "windows": [_view(checked, view) for view in found.windows],
        "blame": [{"one": one, "other": other, "correlation": value} for one, other, value in blamed(told)],
        "deviation": {
            f"{nudge.kind} {nudge.name}": plain(value) for nudge, value in zip(told.nudges, told.deviation, strict=True)
        },
    }


def _view(checked: Checked, view: View) -> dict[str, Any]:
    names = checked.twin.model.state_names
    return {
        "begin": view.begin * 1e-9,
        "end": view.end * 1e-9,
        "rank": view.rank,
        "conditioning": plain(view.conditioning),
        "eigenvalues": plain(view.eigenvalues),
        "left": {name: plain(value) for name, value in zip(names, view.deviation, strict=True)},
        "weakest": view.text,
    }


def smallest_visible(found: Sensitivity) -> list[dict[str, Any]]:
    """One entry a nudge: `size` in `unit`, and from `low` to `high` what passes unseen."""
    return [
        {
            "kind": nudge.kind,
            "name": nudge.name,
            "unit": nudge.unit,
            "value": plain(nudge.value),
            "size": plain(size),
            "low": plain(low),
            "high": plain(high),
            "seen": bool(np.isfinite(size)),
        }
        for nudge, size, (low, high) in zip(found.nudges, found.smallest_visible, found.unseen, strict=True)
    ]


def _integrity(checked: Checked) -> dict[str, Any]:
    found = checked.sensitivity
    if found.reason:
        return {"reason": found.reason, "states": {}}
    states = {
        name: {**plain(bound), "fault": bound.fault or None}
        for name, bound in bounds_of(checked.twin.model, found).items()
    }
    return {"reason": "", "note": found.note, "estimator": found.estimator, "states": states}


def _held_out(checked: Checked) -> dict[str, Any]:
    return {
        row.row: {
            "sensor": row.sensor,
            "unit": row.unit,
            "n": row.n,
            "rms": plain(row.rms),
            "bias": plain(row.bias),
            "coverage": {
                f"{100 * band:.0f}": {"value": plain(value), "low": plain(low), "high": plain(high)}
                for band, value, (low, high) in zip(BANDS, row.coverage, row.intervals, strict=True)
            },
            "open_loop": plain(row.open_loop),
            "worse": row.worse,
        }
        for row in checked.held_out.rows
    }


def _open_loop(checked: Checked) -> dict[str, Any]:
    rows, states = checked.held_out.rows, checked.held_out.states
    return {
        "sensors": {row.row: {"unit": row.unit, "rms": plain(row.open_loop)} for row in rows},
        "states": {
            item.state: {
                "unit": item.unit,
                "rms": plain(item.open_loop),
                "filter": plain(item.filter),
                "worse": item.worse,
            }
            for item in states
        },
    }


def _timing(checked: Checked) -> dict[str, Any]:
    section, policy = checked.twin.config.time, checked.twin.policy
    return {
        "stamps": stamps(checked),
        "horizon": section.horizon,
        "degraded_after": plain(policy.degraded_after),
        "stale_after": plain(policy.stale_after),
        "stale": checked.counts["stale"],
        "sensors": {item.sensor: plain(item) for item in checked.arrivals},
    }


def _posterior(checked: Checked) -> dict[str, Any]:
    return {"peaks": plain(checked.peaks), "tails": {tail.row: plain(tail) for tail in checked.tails}}


def _linearity(checked: Checked) -> dict[str, Any]:
    found = checked.linearity
    return {
        **{name: getattr(found, name) for name in ("reason", "exact", "passes", "white", "text")},
        "states": {item.name: plain(item) for item in found.states},
        "rows": {item.name: plain(item) for item in found.rows},
        "whiteness": {item.row: plain(item) for item in found.whiteness},
    }


def _health(checked: Checked) -> dict[str, Any]:
    track = checked.fold.track
    share = np.bincount(track.health, minlength=len(HEALTH_NAMES)) / max(1, len(track))
    return {
        "share": {name: float(value) for name, value in zip(HEALTH_NAMES, share, strict=True)},
        "false_alarm_every": plain(checked.twin.policy.false_alarm_every),
        "episodes": [episode_json(episode) for episode in checked.episodes],
    }
