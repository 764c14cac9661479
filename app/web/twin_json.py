"""A running twin as JSON: its state, its episodes, and its names, units and options, which never change."""

from __future__ import annotations

from estimators.diagnostics.detectors import detector_of
from estimators.diagnostics.episodes import episode_json
from estimators.diagnostics.references import state_grades
from estimators.registry import ESTIMATORS, unfit
from estimators.track import HEALTH_NAMES

from ..charts.sensor_groups import groups_json, sensor_groups
from ..columns import columns_of
from ..engine import faults
from ..engine.copies import Status
from ..engine.engine import Engine
from ..render.report_charts import charted_model
from ..result import JsonObject, plain
from ..study.commission import storable
from ..study.fit_json import nis_json
from ..twin.changes import began_as, turned

STATUS_FIELDS = (
    "estimator", "options", "revision", "refolding", "awaited", "compiling", "t", "since", "cause", "episodes_open",
    "lost", "model_version", "clock", "counts", "account", "paused", "withheld",
    "finished", "speed", "seekable", "latency_ms",
)  # fmt: skip
"""Fields of `Status` that JSON has under the same name."""


TRUST_FIELDS = (
    "t", "health", "since", "cause", "sensors", "episodes_open", "lost", "nis", "nis_low", "nis_high", "nis_dof",
    "nis_judged", "nis_place", "nis_words", "groups", "withheld", "states",
)  # fmt: skip
"""Fields of a status that belong to its time."""


def moment_json(engine: Engine, t: int) -> JsonObject:
    """Return the `TRUST_FIELDS` of the status at a time, ns."""
    found = status_json(engine, engine.status_at(t))
    return {name: found[name] for name in TRUST_FIELDS}


def status_json(engine: Engine, status: Status | None = None) -> JsonObject:
    """Return the state of a running twin, or the given one; infinity is "inf", NaN null."""
    status, twin, revisions = status or engine.status(), engine.twin, engine.revisions
    edits = revisions.edits
    tuning, runs, levels = status.tuning, engine.revisions.runs, status.integrity
    found = {name: getattr(status, name) for name in STATUS_FIELDS} | {
        "twin": twin.name,
        "title": twin.title,
        "tuning": {item.key: item.value for item in tuning.items()},
        "tuning_name": tuning.name,
        "gate": tuning.gate,
        "gate_kind": tuning.gate_kind,
        "gate_reopen": tuning.reopen,
        "began_as": began_as(twin),
        "turned": turned(twin, status.estimator, tuning),
        "health": HEALTH_NAMES[status.health],
        "states": {
            name: {"grade": grade, "reason": reason}
            for name, (grade, reason) in state_grades(engine.model, status.grades, status.health, status.cause).items()
        },
        **nis_json(status.nis),
        "late": {"inflate": twin.late.inflate, "reason": twin.late.reason},
        "degraded_after": {"seconds": twin.degraded.seconds, "reason": twin.degraded.reason},
        "length": None if status.span is None else (status.span[1] - status.span[0]) * 1e-9,
        "recording": None if status.recording is None else str(status.recording),
        "recording_folder": None if status.recording is None else str(status.recording.absolute().parent),
        "faults": faults.status_json(status.faults, engine.model),
        # The edits that Undo and Redo would take back and make again, in words; null for none.
        "edits": {
            "undo": edits.done[-1].words if edits.done else None,
            "redo": edits.undone[-1].words if edits.undone else None,
        },
        # `version` tells when to ask /api/runs again; `kept` are the runs with a track.
        "runs": {
            "version": revisions.version,
            "last": runs[-2].number if len(runs) > 1 else None,
            "kept": [run.number for run in runs if run.track is not None or run is runs[-1]],
            "pinned": [
                {"number": run.number, "place": run.place, "name": run.name, "running": run is runs[-1]}
                for run in runs
                if run.pinned
            ],
        },
        # Protection levels beside 2 σ by state, their age, s, and why there are none.
        "integrity": {}
        if levels is None
        else {
            name: {key: getattr(item, key) for key in ("bound", "two_sigma", "unit", "fault")}
            for name, item in levels.bounds.items()
        },
        "integrity_age": None if levels is None else levels.age(status.t),
        "integrity_note": "not computed yet" if levels is None else levels.reason,
    }
    # Plain already: thousands of entries if there are as many sensors.
    of_sensors = {
        "used": dict(zip(engine.model.sensor_names, tuning.used.tolist(), strict=True)),
        "sensors": {name: {"state": state, "text": text} for name, (state, text) in status.sensors.items()},
        "groups": groups_json(sensor_groups(engine.model), status.sensors, status.sensor_nis),
    }
    return plain(found, infinity_text=True) | of_sensors  # type: ignore[no-any-return]


def episodes_json(engine: Engine) -> list[JsonObject]:
    """Return all episodes by their start: times in seconds of the log, `help` in docs/alarms.md."""
    return [
        episode_json(episode) | {"help": f"docs/alarms.md#{row.anchor}", "severity": row.severity}
        for episode in engine.episodes()
        for row in [detector_of(episode.cause)]
    ]


def annotations_json(engine: Engine) -> list[JsonObject]:
    """Return all notes of users by time, in seconds of the log."""
    return [{"number": note.number, "at": note.t * 1e-9, "text": note.text} for note in engine.annotations.notes]


def model_json(engine: Engine) -> JsonObject:
    """Return names, units and configured values of a twin, and every estimator with its options or why it is unfit."""
    model, twin = engine.model, engine.twin

    def options(name: str) -> list[JsonObject]:
        configured = dict(twin.options_of(name))
        return [
            option._asdict() | {"whole": option.whole, "configured": configured.get(option.name, option.default)}
            for option in ESTIMATORS[name].options
        ]

    found = {
        "twin": twin.name,
        "title": twin.title,
        "model": model.name,
        **charted_model(model, twin.config.view),
        "field": model.grid is not None,
        "sensors": model.sensor_names,
        "families": {sensor.name: sensor.family for sensor in model.sensors if sensor.family},
        "inputs": [{"name": item.name, "unit": item.unit, "value": item.default} for item in model.inputs],
        "parameters": [item.name for item in model.parameters],
        "pairs": [[model.shown_states[k].name for k in pair] for pair in engine.pairs],
        "tuning": [
            {"key": item.key, "unit": item.unit, "low": item.low, "high": item.high, "configured": item.value}
            for item in twin.tuning.items()
        ],
        "configured": {
            "estimator": twin.estimator,
            "gate": twin.tuning.gate,
            "gate.kind": twin.tuning.gate_kind,
            "gate.reopen": twin.tuning.reopen,
        },
        "estimators": [
            {"name": name}
            | {field: getattr(entry, field) for field in ("title", "family", "assumes", "fails_when", "source")}
            | {"reason": unfit(entry, model), "options": options(name)}
            for name, entry in ESTIMATORS.items()
        ],
        "commissioned": twin.tuning.baseline is not None,
        "baseline_forced": twin.forced_baseline,
        "baseline_storable": storable(twin),
        "window": twin.config.view.window,
        "recorded": twin.recorded or twin.plan.recorded,
        "speed": twin.config.view.speed,
        "at": twin.config.view.cursor,
        "scene": twin.config.view.scene.kind,
        "columns": list(columns_of(model)),
    }
    return dict(plain(found))
