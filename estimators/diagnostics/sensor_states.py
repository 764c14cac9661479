"""The state of each sensor, in a word: one machine a sensor, beside that of the twin."""

from __future__ import annotations

import numpy as np

from ..events.batch import READING, Events
from ..model.state_space import StateSpaceModel
from ..track import HELD_OUT, MISSING, Track
from .evidence import LOST, SENSORS, causes_now, heard_last
from .health import HealthPolicy

STATES = ("waiting", "tracking", "suspect", "degraded", "stale", "held out")
"""Of a sensor: nothing came yet; consistent; consistent no more; silent, stuck or refused; silent for so long that the
twin would be stale if it had no other; predicted and scored, never used."""


def sensor_states(
    model: StateSpaceModel, used: np.ndarray, evidence: np.ndarray, now: float, policy: HealthPolicy
) -> list[str]:
    """One of `STATES` for each sensor.

    Args:
        model: The model.
        used: Which sensors are used, (sensors,) of bool.
        evidence: The bank's state, see evidence/.
        now: Time of the last event, s.
        policy: When the estimate may be trusted.
    """
    of_rows, of_sensors, silent = causes_now(model, evidence)
    last = heard_last(model, evidence)
    found = []
    for s, sensor in enumerate(model.sensors):
        start = model.row_start[s]
        said = int(np.bitwise_or.reduce(of_rows[start : start + len(sensor.rows)], initial=int(of_sensors[s])))
        if not used[s]:
            word = "held out"
        elif silent[s]:
            word = "stale" if now - last[s] > policy.stale_after else "degraded"
        elif not np.isfinite(last[s]):
            word = "waiting"
        elif said & LOST:
            word = "degraded"
        else:
            word = "suspect" if said else "tracking"
        found.append(word)
    return found


def states_along(events: Events, track: Track, s: int) -> tuple[np.ndarray, np.ndarray]:
    """The state of sensor s over time, as far as single rows tell it: one that is stale is degraded here.

    Returns:
        Indices of the rows that say something of the sensor, ascending (k,), and indices into `STATES` (k,).
    """
    silent = track.flags >> s & 1 != 0 if s < SENSORS else np.zeros(len(events), bool)
    spoke = (events.kind == READING) & (events.channel == s) & (track.verdict != MISSING)
    rows = np.flatnonzero(silent | spoke)
    said = np.bitwise_or.reduce(track.alarms[rows], axis=1) * spoke[rows]
    words = ("held out", "degraded", "suspect")
    cases = (track.verdict[rows] == HELD_OUT, silent[rows] | (said & LOST != 0), said != 0)
    states = np.select(cases, [STATES.index(word) for word in words], STATES.index("tracking"))
    return rows, states
