"""Why a twin has its health at a time: the episodes in alarm then that give it, live and at the end of a fold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from estimators.diagnostics.detector_state import SENSOR_STATES, sensor_states_over_time
from estimators.diagnostics.detectors import IMPOSSIBLE, IMPOVERISHED, detector_of, is_outside, memory_flag
from estimators.diagnostics.episodes import Episode
from estimators.log import Events
from estimators.model.state_space import Input, State, StateSpaceModel
from estimators.track import DEGRADED, HEALTH_NAMES, SUSPECT, TRACKING, WAITING, Track

FLAGS = {"impossible": IMPOSSIBLE, "impoverished": IMPOVERISHED}
LOST = HEALTH_NAMES[DEGRADED]


def leading(
    model: StateSpaceModel, episodes: Iterable[Episode], states: Mapping[str, str], track: Track, u: np.ndarray
) -> tuple[list[Episode], str]:
    """Return the episodes that give the twin its health after the last of some rows, and the cause in words.

    The most severe is the first, of these the newest, and the cause is its text. An alarm has no episode yet when it
    begins, or none any more while the slowest test clears: without any the cause names the sensors in alarm.

    Args:
        model: The model.
        episodes: Those that last then.
        states: The state of each sensor then.
        track: Rows of a fold, at least one.
        u: Inputs after the last of them (nu,).
    """
    health, grade = int(track.health[-1]), HEALTH_NAMES[track.health[-1]]
    if health in (WAITING, TRACKING):
        return [], ""
    items: tuple[State | Input, ...] = (*model.shown_states, *model.inputs)
    flags, values = int(track.flags[-1]), (*track.mean[-1], *u)
    own = {
        "outside": [item.name for item, value in zip(items, values, strict=False) if is_outside(item, value)],
        "corrected": [state.name for k, state in enumerate(model.shown_states) if flags & memory_flag(k)],
    }
    alarmed = [name for name, state in states.items() if (LOST if state == "stale" else state) == grade]

    def gives(episode: Episode) -> bool:
        """Return whether it is in alarm with the grade of the twin: not that of a loss which is over."""
        subject, cause, detector = episode.subject, episode.cause, detector_of(episode.cause)
        if detector.alarms or detector.grade == LOST:
            mine = subject in alarmed or subject.rpartition(".")[0] in alarmed
            return mine and (grade == LOST or detector.grade != LOST)
        on = subject in own.get(cause, ()) or flags & FLAGS.get(cause, 0) != 0
        return cause == grade or (health == SUSPECT and on)

    found = sorted(filter(gives, episodes), key=lambda episode: (episode.grade != grade, severity(episode)))
    return found, found[0].text if found else f"{', '.join(alarmed)} {grade}" * bool(alarmed)


def severity(episode: Episode) -> tuple[int, float]:
    """Sort key: the most severe first, of these the newest; advisories last."""
    own = detector_of(episode.cause).severity
    return own + detector_of("").severity * (episode.grade == "advisory"), -episode.start


def states_of_rows(model: StateSpaceModel, used: np.ndarray, events: Events, track: Track) -> dict[str, str]:
    """Return the state of each sensor as the last of these rows that concern it show it; `used` (sensors,) of bool."""
    found = {}
    for s, name in enumerate(model.sensor_names):
        rows, states = sensor_states_over_time(events, track, s)
        found[name] = "held out" if not used[s] else SENSOR_STATES[states[-1]] if rows.size else "waiting"
    return found
