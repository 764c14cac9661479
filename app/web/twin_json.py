"""A running twin as JSON: its state, its episodes, its faults, and what never changes: names, units and options."""

from __future__ import annotations

import math
from typing import Any

from estimators.diagnostics.consistency import NisVerdict
from estimators.diagnostics.detectors import detector_of
from estimators.diagnostics.episodes import episode_json
from estimators.estimator import Estimator, Option
from estimators.registry import ESTIMATORS, unfit
from estimators.track import HEALTH_NAMES

from ..live import faults
from ..live.changes import began_as, turned
from ..live.outputs import Status
from ..live.revisions import Revisions
from ..live.running_fold import Running
from ..present.export.report_charts import charted_model
from ..present.series.columns import columns_of


def status_json(engine: Running) -> dict[str, Any]:
    """Return the state of a running twin, as the page's header shows it and more."""
    status = engine.status()
    commissioned = status.tuning.baseline is not None
    judged = NisVerdict(status.nis, status.nis_low, status.nis_high, commissioned, status.nis_judged)
    return {
        "twin": engine.twin.name,
        "title": engine.twin.title,
        "estimator": status.estimator,
        "options": _plain(dict(status.options)),
        "tuning": {key: _plain(value) for key, value, *_ in status.tuning.items()},
        "tuning_name": status.tuning.name,
        "gate": _plain(status.tuning.gate),
        "gate_kind": status.tuning.gate_kind,
        "gate_reopen": _plain(status.tuning.reopen),
        "used": {name: bool(status.tuning.get(f"use.{name}")) for name in engine.model.sensor_names},
        "began_as": began_as(engine.twin),
        "turned": _plain(turned(engine.twin, status.estimator, status.tuning)),
        "revision": status.revision,
        "refolding": status.refolding,
        "awaited": status.awaited,
        "compiling": dict(status.compiling),
        "t": status.t,
        "health": HEALTH_NAMES[status.health],
        "since": status.since,
        "cause": status.cause,
        "sensors": {name: {"state": state, "text": text} for name, (state, text) in status.sensors.items()},
        "episodes_open": status.episodes_open,
        "lost": status.lost,
        "nis": _plain(status.nis),
        "nis_low": _plain(status.nis_low),
        "nis_high": _plain(status.nis_high),
        "nis_judged": _plain(judged.measure),
        "nis_place": judged.place,
        "nis_words": judged.words,
        "late": {"inflate": engine.twin.late.inflate, "reason": engine.twin.late.reason},
        "degraded_after": {"seconds": engine.twin.degraded.seconds, "reason": engine.twin.degraded.reason},
        "model_version": status.model_version,
        "clock": None
        if status.clock is None
        else {key: _plain(value) for key, value in status.clock._asdict().items()},
        "counts": dict(status.counts),
        "account": _plain(status.account),
        "paused": status.paused,
        "finished": status.finished,
        "speed": _plain(status.speed),
        "seekable": status.seekable,
        "length": None if status.span is None else (status.span[1] - status.span[0]) * 1e-9,
        "recording": str(status.recording) if status.recording is not None else None,
        "recording_folder": None if status.recording is None else str(status.recording.absolute().parent),
        "latency_ms": _plain(status.latency_ms),
        "faults": faults.status_json(status.faults, engine.model),
        "runs": _runs(engine.revisions),
        **_integrity(status),
    }


def _runs(revisions: Revisions) -> dict[str, Any]:
    """When to ask /api/runs again (`version`), the run before the running one, those with a track, the pinned ones."""
    runs = revisions.runs
    return {
        "version": revisions.version,
        "last": runs[-2].number if len(runs) > 1 else None,
        "kept": [run.number for run in runs if run.track is not None or run is runs[-1]],
        "pinned": [
            {"number": run.number, "place": run.place, "name": run.name, "running": run is runs[-1]}
            for run in runs
            if run.pinned
        ],
    }


def episodes_json(engine: Running) -> list[dict[str, Any]]:
    """Return all episodes by their start: times in seconds of the log, `help` in docs/alarms.md."""
    return [
        episode_json(episode) | {"help": f"docs/alarms.md#{row.anchor}", "severity": row.severity}
        for episode in engine.episodes()
        for row in [detector_of(episode.cause)]
    ]


def faults_json(engine: Running) -> dict[str, Any]:
    """The faults that can be put into the source."""
    return faults.catalogue_json(engine.source, engine.model)


def _integrity(status: Status) -> dict[str, Any]:
    """By state the bound of its error under one unseen fault, beside 2 σ; how old that is, s; why there is none."""
    found = status.integrity
    if found is None:
        return {"integrity": {}, "integrity_age": None, "integrity_note": "not computed yet"}
    bounds = {
        name: {"bound": _plain(item.bound), "two_sigma": _plain(item.two_sigma), "unit": item.unit, "fault": item.fault}
        for name, item in found.bounds.items()
    }
    return {"integrity": bounds, "integrity_age": found.age(status.t), "integrity_note": found.reason}


def _plain(value: Any) -> Any:
    """JSON has no infinity and no NaN."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, (bool, str, int)):
        return value
    number = float(value)
    return number if math.isfinite(number) else str(number) if math.isinf(number) else None


def model_json(engine: Running) -> dict[str, Any]:
    """The twin in names, units and configured values; every estimator with its options, or why it does not apply."""
    model, twin = engine.model, engine.twin
    view = twin.config.view
    return {
        "twin": twin.name,
        "title": twin.title,
        "model": model.name,
        **charted_model(model),
        "field": model.grid is not None,
        "sensors": list(model.sensor_names),
        "inputs": [{"name": item.name, "unit": item.unit, "value": item.default} for item in model.inputs],
        "parameters": [item.name for item in model.parameters],
        "pairs": [[model.shown_states[i].name, model.shown_states[j].name] for i, j in engine.pairs.tolist()],
        "tuning": [
            {
                "key": item.key,
                "unit": item.unit,
                "low": _bound(item.low),
                "high": _bound(item.high),
                "configured": item.value,
            }
            for item in twin.tuning.items()
        ],
        "configured": {
            "estimator": twin.estimator,
            "gate": twin.tuning.gate,
            "gate.kind": twin.tuning.gate_kind,
            "gate.reopen": twin.tuning.reopen,
        },
        "estimators": [
            {
                "name": name,
                "title": entry.title,
                "family": entry.family,
                "assumes": entry.assumes,
                "fails_when": entry.fails_when,
                "source": entry.source,
                "reason": unfit(entry, model),
                "options": [_option(entry, option, engine) for option in entry.options],
            }
            for name, entry in ESTIMATORS.items()
        ],
        "commissioned": twin.tuning.baseline is not None,
        "window": view.window,
        "scene": view.scene.kind,
        "columns": list(columns_of(model)),
    }


def _option(entry: Estimator, option: Option, engine: Running) -> dict[str, Any]:
    configured = dict(engine.twin.options_of(entry.name)).get(option.name, option.default)
    return {
        "name": option.name,
        "default": float(option.default),
        "configured": float(configured),
        "low": _bound(option.low),
        "high": _bound(option.high),
        "unit": option.unit,
        "meaning": option.meaning,
        "choices": list(option.choices),
        "whole": option.whole,
    }


def _bound(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
