"""True states and held-out sensors, which judge a fold that did not use them; estimates too uncertain to be shown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ..errors import spaced
from ..events.batch import Events, truth_of
from ..model.state_space import Input, State, StateSpaceModel
from ..numerics.linalg import wrapped
from ..track import HEALTH_NAMES, HELD_OUT, SUSPECT, TRACKING, WAITING, Track
from .detectors import FAR_OUTSIDE, IMPOSSIBLE_AT, MEMORY_AT, is_outside, memory_flag


class Reference(NamedTuple):
    """A true state (`truth`), or a row of a held-out sensor.

    At the events `rows` (n,): `error` (n,), reference less prediction, and `std` (n,) of the prediction, in `unit`.
    """

    name: str
    unit: str
    truth: bool
    rows: np.ndarray
    error: np.ndarray
    std: np.ndarray

    @property
    def log_density(self) -> np.ndarray:
        """Log density of the reference under its prediction, (n,)."""
        return -0.5 * (self.error / self.std) ** 2 - np.log(self.std) - 0.5 * np.log(2.0 * np.pi)

    def finite(self) -> Reference:
        """Return the events with a finite error and a positive standard deviation."""
        kept = np.isfinite(self.error) & (self.std > 0.0)
        return self._replace(rows=self.rows[kept], error=self.error[kept], std=self.std[kept])


def true_states(model: StateSpaceModel, events: Events, track: Track) -> Iterator[Reference]:
    """Yield the shown states with a known truth at the rows of a track."""
    for column, (j, state) in enumerate(zip(model.shown, model.shown_states, strict=True)):
        rows, true = truth_of(events, int(j))
        if rows.size:
            error = wrapped(true - track.mean[rows, column], state.circular)
            yield Reference(state.name, state.unit, True, rows, error, track.std[rows, column])


def held_out_references(model: StateSpaceModel, events: Events, track: Track, s: int) -> Iterator[Reference]:
    """Yield the rows of sensor s, where a fold held it out."""
    own = events.of_sensor(s)
    own = own[track.verdict[own] == HELD_OUT]
    for k, row in enumerate(model.sensors[s].rows):
        name = model.row_names[model.row_start[s] + k]
        yield Reference(name, row.unit, False, own, track.innovation[own, k], track.innovation_std[own, k])


HALF_WIDTH = 1.959963984540054  # Half-width of a 95 % band, in standard deviations


def withheld(model: StateSpaceModel, track: Track) -> np.ndarray:
    """Return where a shown state is withheld, (n, shown)."""
    return np.column_stack([hidden(track, k, state.withhold) for k, state in enumerate(model.shown_states)])


def hidden(track: Track, column: int, limit: float) -> np.ndarray:
    """Return where a shown state with this limit is withheld, (n,): its band exceeds it, or the model is far out."""
    far = track.flags & (FAR_OUTSIDE if limit < np.inf else 0) != 0
    return (track.std[:, column] > limit / HALF_WIDTH) | far


def shown_track(model: StateSpaceModel, track: Track) -> Track:
    """Return a track with NaN in place of the withheld estimates, for views of the mean."""
    where = withheld(model, track)
    return track._replace(mean=np.where(where, np.nan, track.mean)) if where.any() else track


WITHHELD = "withheld"  # Grade of a state beside those of health
SUSPICIONS = {
    MEMORY_AT: "corrected by more than its band allows, over its memory or from its prior",
    IMPOSSIBLE_AT: "its band was beyond its physical limits, and measurements have not corrected it by as much",
}
"""Why a state is suspect by itself, by the first bit of `Track.flags` of that; the last one counts."""


def state_grades(
    model: StateSpaceModel, own: Mapping[str, tuple[str, str]], health: int, cause: str
) -> dict[str, tuple[str, str]]:
    """Return grade and reason of each shown state: its own, or the health of the twin with its cause if that is worse.

    Args:
        model: The model.
        own: Those of `own_grades`.
        health: Health of the twin; before the first measurement nothing is withheld.
        cause: Its cause, or "".
    """
    twin = HEALTH_NAMES[health], "" if health == TRACKING else cause or f"the twin is {HEALTH_NAMES[health]}"
    worse = [WITHHELD, HEALTH_NAMES[SUSPECT]] if health <= SUSPECT else [WITHHELD]
    return {
        name: own[name] if health != WAITING and name in own and own[name][0] in worse else twin
        for name in (state.name for state in model.shown_states)
    }


def state_health(track: Track, column: int) -> np.ndarray:
    """Return the health of a shown state at each row, (n,): that of the twin, or suspect by itself."""
    own = (track.flags & memory_flag(column) != 0) & (track.health != WAITING)
    return np.where(own, np.maximum(track.health, SUSPECT), track.health)


def own_grades(model: StateSpaceModel, track: Track, u: np.ndarray) -> dict[str, tuple[str, str]]:
    """Return grade and reason of each state whose last estimate is withheld, or suspect by itself.

    Args:
        model: The model.
        track: Rows of a fold, at least one.
        u: Inputs at the last of them (nu,).
    """
    items: tuple[State | Input, ...] = (*model.shown_states, *model.inputs)
    left = [
        f"{item.name} {value:.4g}{spaced(item.unit)}, fitted at {item.fitted[0]:.4g} to {item.fitted[1]:.4g}"
        for item, value in zip(items, (*track.mean[-1], *u), strict=True)
        if item.fitted is not None and is_outside(item, value)
    ]
    why = f"outside the fitted range ({'; '.join(left)})" if left else "too uncertain"
    grades = {
        state.name: (HEALTH_NAMES[SUSPECT], text)
        for k, state in enumerate(model.shown_states)
        for at, text in SUSPICIONS.items()
        if track.flags[-1] & memory_flag(k, at)
    }
    return grades | {
        state.name: (WITHHELD, f"{why}, ± {float(f'{HALF_WIDTH * deviation:.2g}'):g}{spaced(state.unit)}")
        for state, deviation, without in zip(model.shown_states, track.std[-1], withheld(model, track)[-1], strict=True)
        if without
    }


def references(model: StateSpaceModel, events: Events, track: Track) -> list[Reference]:
    """Return all finite references of a track: true states first, then the rows of held-out sensors."""
    found = [*true_states(model, events, track)]
    for s in range(len(model.sensors)):
        found += held_out_references(model, events, track, s)
    return [item for item in map(Reference.finite, found) if item.rows.size]
