"""Localisation: a measurement acts only near its sensor, since far from it an ensemble's covariances are mostly chance.

The neighbourhoods are computed once, when a fold is prepared, and laid out by blocks of states as the analysis goes
through them (see blocks.py): for each sensor the blocks that it reaches, for each of these the sensor's rows that reach
it, and for each such row the taper at each of the block's states.

Source: Gaspari & Cohn (1999), doi:10.1002/qj.49712555417, equation 4.10, with c half the radius.
"""

from __future__ import annotations

import itertools

import numba
import numpy as np

from ..errors import EstimatorError
from ..estimator import Options
from ..model.parts import Field
from ..model.state_space import StateSpaceModel
from ..numerics.jit import floats, ints, jit, matrix, threaded
from ..numerics.simd import WIDE
from ..numerics.simd_ir import LANES

_FIELDS = 6
"""Numbers per sensor in the table: count of blocks, and where they, their rows' starts, rows, tapers and the tapers
between the sensor's own rows begin, in units of 8 bytes from the table's start. The first number of all is 1."""


MAX_TURNS = 8
"""Turns of a periodic axis that the radius may have; with more the taper is 1 all the way round."""

MAX_TABLE_BYTES = 2e9
"""Largest table: localisation that reaches everywhere is none."""


def crews(numbers: int, threaded_from: int) -> int:
    """Return the number of threads that share the work on an ensemble of so many numbers."""
    return int(numba.config.NUMBA_NUM_THREADS) if numbers >= threaded_from and threaded() else 1


def gaspari_cohn(distance: np.ndarray, radius: float) -> np.ndarray:
    """Return the taper: 1 at distance 0, 5/24 at half the radius, 0 from the radius on.

    It is positive definite in up to 3 dimensions.

    Source: Gaspari & Cohn (1999), doi:10.1002/qj.49712555417, equation 4.10.
    """
    z = np.asarray(distance, float) / (0.5 * radius)
    near = (((-0.25 * z + 0.5) * z + 0.625) * z - 5.0 / 3.0) * z**2 + 1.0
    with np.errstate(divide="ignore"):
        far = ((((z / 12.0 - 0.5) * z + 0.625) * z + 5.0 / 3.0) * z - 5.0) * z + 4.0 - 2.0 / (3.0 * z)
    return np.where(z <= 1.0, near, np.where(z < 2.0, np.maximum(far, 0.0), 0.0))


def taper_between(
    a: np.ndarray, b: np.ndarray, periods: np.ndarray, radius: float, shortest: bool = False
) -> np.ndarray:
    """Return the taper between places a and b (..., axes), on axes with these periods, infinite where not periodic.

    On a periodic axis with `shortest` it is that of the distance the short way round. Otherwise those of the ways that
    are full turns longer and within the radius are added, relative to the sum at distance 0. The short way alone has a
    kink half way round, so from a radius of half the period on it would not be positive definite, and neither the
    innovation covariance. The sum is: its Fourier coefficients are values of the transform of the taper.
    """
    difference = np.abs(a - b) % periods
    difference = np.minimum(difference, periods - difference)
    if shortest:
        return gaspari_cohn(np.sqrt(np.sum(difference**2, axis=-1)), radius)
    # Of many turns the sum is nearly the same all the way round: 5e-5 less at most.
    uniform = radius > MAX_TURNS * periods
    difference, periods = np.where(uniform, 0.0, difference), np.where(uniform, radius / MAX_TURNS, periods)
    turns = [range(-most, most + 1) for most in np.floor(radius / periods + 0.5).astype(int)]
    total, at_0 = np.zeros(difference.shape[:-1]), 0.0
    for count in itertools.product(*turns):
        shift = np.array([k * period if k else 0.0 for k, period in zip(count, periods, strict=True)])
        total += gaspari_cohn(np.sqrt(np.sum((difference + shift) ** 2, axis=-1)), radius)
        at_0 += float(gaspari_cohn(np.sqrt(np.sum(shift**2)), radius))
    return total / at_0


def check_placed(model: StateSpaceModel, radius: float) -> None:
    """Refuse a radius of localisation on a model without positions; 0 is none.

    Raises:
        EstimatorError: If the radius is positive and a state or a sensor row has no position, or rows are correlated:
            making them independent mixes rows at different places.
    """
    if not radius > 0:
        return
    if model.correlated:
        raise EstimatorError(
            f"radius is {radius:g}, but the rows of {model.name}'s sensor {model.correlated} are correlated: made "
            "independent, none of them has a place of its own; set radius to 0, or leave the correlation out"
        )
    states = isinstance(model.states, Field) or all(state.position is not None for state in model.states)
    if states and all(row.position is not None for sensor in model.sensors for row in sensor.rows):
        return
    what = "sensor rows" if states else "states"
    raise EstimatorError(
        f"radius is {radius:g}, but model {model.name} does not say where its {what} are; "
        "give them positions, or set radius to 0"
    )


def prepare(model: StateSpaceModel, options: Options, shortest: bool = False) -> np.ndarray:
    """Return the layout of blocks, rows and tapers as int64s (float64s among them by their bits).

    With `shortest` the tapers between rows and states are those of the short way round: weights need not be definite.

    Raises:
        EstimatorError: If a radius is given and the model has no positions of its states or sensors, or the layout
            would not fit into memory.
    """
    radius = options.get("radius", 0.0)
    if not radius > 0:
        return np.zeros(1, np.int64)
    check_placed(model, radius)
    places = model.positions()
    assert places is not None
    rows = [[row.position for row in sensor.rows] for sensor in model.sensors]
    from scipy.spatial import cKDTree

    periods = np.array(model.periods or (np.inf,) * places.shape[1])
    boxed = np.where(np.isfinite(periods), periods, 0.0)
    tree = cKDTree(np.where(boxed > 0, places % np.where(boxed > 0, boxed, 1.0), places), boxsize=boxed)
    parts: list[np.ndarray] = []
    heads = np.zeros((len(rows), _FIELDS), np.int64)
    at = 1 + heads.size
    for k, sensor in enumerate(rows):
        own = np.array(sensor, float)
        where = np.where(boxed > 0, own % np.where(boxed > 0, boxed, 1.0), own)
        near = [np.array(tree.query_ball_point(place, radius), np.int64) for place in where]
        each = zip(near, own, strict=True)
        tapers = [taper_between(places[found], place, periods, radius, shortest) for found, place in each]
        layout = _by_blocks(near, tapers, model.nx)
        between = taper_between(own[:, None], own[None], periods, radius)
        heads[k, 0] = layout[0].size
        for field, part in enumerate((*layout, between), start=1):
            heads[k, field] = at
            parts.append(np.ascontiguousarray(part).view(np.int64).ravel())
            at += parts[-1].size
        if 8 * at > MAX_TABLE_BYTES:
            raise EstimatorError(
                f"radius is {radius:g}: its tapers on {model.nx:,} states take more than {MAX_TABLE_BYTES * 1e-9:g} "
                "GB; choose a smaller one, or 0 for no localisation"
            )
    return np.concatenate([np.ones(1, np.int64), heads.ravel(), *parts])


def _by_blocks(
    near: list[np.ndarray], tapers: list[np.ndarray], nx: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return blocks reached, where each one's entries start (blocks + 1,), each entry's row and tapers (WIDE,)."""
    wide = nx // WIDE
    blocks, rows, taper = [], [], []
    for row, (states, values) in enumerate(zip(near, tapers, strict=True)):
        narrow = states >= wide * WIDE
        block = np.where(narrow, wide + (states - wide * WIDE) // LANES, states // WIDE)
        lane = np.where(narrow, (states - wide * WIDE) % LANES, states % WIDE)
        reached, inverse = np.unique(block, return_inverse=True)
        table = np.zeros((reached.size, WIDE))
        table[inverse, lane] = values
        blocks.append(reached)
        rows.append(np.full(reached.size, row, np.int64))
        taper.append(table)
    by_entry, of_row, table = np.concatenate(blocks), np.concatenate(rows), np.concatenate(taper)
    order = np.lexsort((of_row, by_entry))
    found, start = np.unique(by_entry[order], return_index=True)
    starts = np.append(start, by_entry.size).astype(np.int64)
    return found.astype(np.int64), starts, of_row[order], table[order]


@jit
def localised(context):
    """Return whether the filter localises."""
    return ints(context.prepared, 1)[0] != 0


@jit
def reached(context, sensor):
    """Return the blocks that a sensor reaches, starts of their entries, rows of the entries, tapers (entries, WIDE)."""
    table = ints(context.prepared, context.n_prepared)
    head = table[1 + _FIELDS * sensor : 1 + _FIELDS * (sensor + 1)]
    count = head[0]
    start = table[head[2] : head[2] + count + 1]
    entries = start[count]
    tapers = matrix(floats(context.prepared, context.n_prepared), head[4], entries, WIDE)
    return table[head[1] : head[1] + count], start, table[head[3] : head[3] + entries], tapers


@jit
def between_rows(context, sensor):
    """Return the taper between a sensor's rows, (ny, ny); (0, 0) where the filter does not localise."""
    if not localised(context):
        return matrix(floats(context.prepared, 1), 0, 0, 0)
    table = ints(context.prepared, context.n_prepared)
    ny = ints(context.row_count, context.n_sensors)[sensor]
    at = table[1 + _FIELDS * sensor + 5]
    return matrix(floats(context.prepared, context.n_prepared), at, ny, ny)
