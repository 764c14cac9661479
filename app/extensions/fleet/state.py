"""Published states of the assets of a fleet: which have changed, and the message of each."""

from __future__ import annotations

import numpy as np

from app.engine.outputs.state_message import StateMessage, calendar_time, iso_now, number_or_none, published_state
from app.twin.twin import Twin
from estimators.diagnostics.references import HALF_WIDTH, WITHHELD, state_grades
from estimators.fleet.table import FleetTable
from estimators.track import HEALTH_NAMES


class ChangedAssets:
    """Assets whose state has changed since it was published; those that have waited longest come first."""

    def __init__(self) -> None:
        self._known = np.full((0, 3), np.nan)
        """Time, events and health of each asset when they were looked at last."""
        self._due = np.zeros(0, np.bool_)
        self._order = np.zeros(0, np.int64)
        """Number of the publication of each asset."""
        self._next = 1

    def update(self, table: FleetTable) -> None:
        """Note the assets of a table that have changed; new ones have."""
        count, known = len(table.assets), self._due.size
        self._due = np.append(self._due, np.ones(count - known, np.bool_))
        self._order = np.append(self._order, np.zeros(count - known, np.int64))
        columns = np.stack([table.seconds, table.events, table.health], axis=1, dtype=float)
        old, new = self._known, columns[:known]
        self._due[:known] |= ((old != new) & ~(np.isnan(old) & np.isnan(new))).any(axis=1)
        self._known = columns

    def pop(self, most: int) -> list[int]:
        """Return the positions of at most so many assets, which count as published."""
        places = np.flatnonzero(self._due)
        places = places[np.argsort(self._order[places], kind="stable")][: max(0, most)]
        self._due[places] = False
        self._order[places] = np.arange(self._next, self._next + places.size)
        self._next += places.size
        found: list[int] = places.tolist()
        return found


def asset_message(twin: Twin, name: str, table: FleetTable, place: int) -> StateMessage:
    """Return the present state of an asset.

    A fleet keeps neither inputs nor counts of each sensor, so the message has none. `age_s` is the age of the last
    measurement at the time of the state, and `time_ns` is rounded to microseconds.

    Args:
        twin: The twin of the assets.
        name: Name of the asset.
        table: States of all assets.
        place: Position of the asset.
    """
    model, health, cause = twin.model, int(table.health[place]), str(table.cause[place])
    seconds = float(table.seconds[place])
    t = round(seconds * 1e6) * 1000 if np.isfinite(seconds) else None
    numbers = [*zip(model.shown_states, table.mean[place].tolist(), table.std[place].tolist(), strict=True)]
    own = {state.name: (WITHHELD, "too uncertain") for state, _, std in numbers if std > state.withhold / HALF_WIDTH}
    grades = state_grades(model, own, health, cause)
    states = tuple(published_state(state, mean, std, grades[state.name]) for state, mean, std in numbers)
    # Per degree of freedom only where each measurement has one.
    nis = float(table.nis_mean[place]) if model.ny == len(model.sensors) else np.nan
    return StateMessage(
        twin=name,
        estimator=twin.estimator,
        time_ns=t,
        time=calendar_time(t),
        sent=iso_now(),
        age_s=number_or_none(float(table.age[place])),
        revision=0,
        tuning=twin.tuning.name or None,
        model_version=1,
        health=HEALTH_NAMES[health],  # type: ignore[arg-type]
        cause=cause,
        estimate_valid=all(item.valid for item in states),
        inputs_valid=True,
        nis=number_or_none(nis),
        states=states,
        inputs=(),
        sensors=(),
        covariance=None,
        covariance_of=None,
    )
