"""Tables of folds: one row per event, one column per state."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..diagnostics.detectors import (
    ALARM_NAMES,
    FAR_OUTSIDE,
    IMPOSSIBLE,
    IMPOVERISHED,
    OUTSIDE,
    SENSOR_FLAGS,
    memory_flag,
)
from ..diagnostics.episodes import Episode, episode_json
from ..diagnostics.references import withheld
from ..events.batch import KIND_NAMES, READING, Events, truth_of
from ..events.maintenance import model_versions
from ..model.state_space import StateSpaceModel
from ..smoothing.walk import Smoothed
from ..track import HEALTH_NAMES, REASONS, VERDICT_NAMES, Track


def table_of(
    model: StateSpaceModel,
    events: Events,
    track: Track,
    episodes: Sequence[Episode] = (),
    *,
    smoothed: Smoothed | None = None,
    tuning_version: int = 1,
    tuning: str = "",
    model_version: int = 1,
) -> Any:
    """Return a pyarrow.Table of events and track.

    Columns: `t_ns`, `arrival_ns`, `seconds`; `event`, `channel`, and `sensor` (null unless a measurement); `value_k`
    and, if measurements have variances of their own, `variance_k`; for each state `NAME_true` (NaN if unknown), `NAME`,
    `NAME_std`, and of a smoothed fold `NAME_smooth` and `NAME_smooth_std`; `innovation_k` and `innovation_std_k`; NIS
    with its windowed mean and bounds, log-likelihood; verdict and health as words; `screened`, the reasons why rows of
    the measurement were rejected before the filter, or null; `model_version`, which increases with each maintenance;
    `tuning_version` and `tuning`, number and name (or null) of the tuning of the track; `alarms`, the causes in alarm
    after the event, and `flags`, other conditions, joined by commas or null. The schema's metadata have `episodes` as
    JSON.
    """
    import pyarrow as pa

    sensors = np.array([*model.sensor_names, None], object)
    columns: dict[str, object] = {
        "t_ns": events.t,
        "arrival_ns": events.arrival,
        "seconds": events.t * 1e-9,
        "event": np.array(KIND_NAMES)[events.kind],
        "channel": events.channel,
        "sensor": pa.array(sensors[np.where(events.kind == READING, events.channel, -1)], pa.string()),
    }
    columns |= {f"value_{k}": events.value[:, k] for k in range(model.width)}
    columns |= {f"variance_{k}": events.value[:, model.width + k] for k in range(events.value.shape[1] - model.width)}
    # The track of a large field has only some of its states.
    shown = [model.state_names[j] for j in model.shown]
    for j, name in zip(model.shown, shown, strict=True):
        rows, values = truth_of(events, int(j))
        true = np.full(len(events), np.nan)
        true[rows] = values
        columns[f"{name}_true"] = true
    hidden = withheld(model, track)
    columns |= {name: np.where(hidden[:, k], np.nan, track.mean[:, k]) for k, name in enumerate(shown)}
    columns |= {f"{name}_std": track.std[:, k] for k, name in enumerate(shown)}
    if smoothed is not None:
        columns |= {f"{name}_smooth": smoothed.mean[:, k] for k, name in enumerate(shown)}
        columns |= {f"{name}_smooth_std": smoothed.std[:, k] for k, name in enumerate(shown)}
    columns |= {f"innovation_{k}": track.innovation[:, k] for k in range(model.ny)}
    columns |= {f"innovation_std_{k}": track.innovation_std[:, k] for k in range(model.ny)}
    for name in ("nis", "nis_mean", "nis_low", "nis_high", "log_likelihood"):
        columns[name] = getattr(track, name)
    columns["verdict"] = np.array(VERDICT_NAMES)[track.verdict]
    columns["screened"] = _words(np.bitwise_or.reduce(track.screened, axis=1), _REASONS)
    columns["health"] = np.array(HEALTH_NAMES)[track.health]
    columns["model_version"] = model_versions(events, model_version)
    columns["tuning_version"] = np.full(len(events), tuning_version, np.int64)
    columns["tuning"] = pa.array([tuning or None] * len(events), pa.string())
    columns["alarms"] = _words(np.bitwise_or.reduce(track.alarms, axis=1, dtype=np.int64), _CAUSES)
    if any(state.withhold < np.inf for state in model.shown_states):
        names = {1 << k: name for k, name in enumerate(shown)}
        columns["withheld"] = _words(hidden @ np.array(list(names), np.int64), names)
    bits = {1 << k: f"{name} silent" for k, name in enumerate(model.sensor_names[:SENSOR_FLAGS])} | _FLAGS
    bits |= {memory_flag(k): f"{name} corrected" for k, name in enumerate(shown)}
    columns["flags"] = _words(track.flags, bits)
    plain = {k: np.ascontiguousarray(c) if isinstance(c, np.ndarray) else c for k, c in columns.items()}
    metadata = {"episodes": json.dumps([episode_json(episode) for episode in episodes])}
    return pa.table(plain).replace_schema_metadata(metadata)


_CAUSES = {1 << k: cause for k, cause in enumerate(ALARM_NAMES)}
_REASONS = {1 << k: reason for k, reason in enumerate(REASONS)}
_FLAGS = {
    IMPOVERISHED: "impoverished",
    OUTSIDE: "outside the fitted range",
    FAR_OUTSIDE: "far outside the fitted range",
    IMPOSSIBLE: "impossible",
}


def _words(masks: np.ndarray, bits: dict[int, str]) -> Any:
    """Return the words of each mask's bits, joined by commas; null where there are none."""
    import pyarrow as pa

    kinds, which = np.unique(masks, return_inverse=True)
    said = [", ".join(word for bit, word in bits.items() if int(mask) & bit) or None for mask in kinds]
    return pa.array(np.array(said, object)[which.reshape(-1)], pa.string())
