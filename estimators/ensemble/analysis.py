"""The workspace of an analysis, the same for all ensemble filters."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..compiled.context import (
    sensor_rows,
)
from ..estimator import Options
from ..model.state_space import LARGE
from ..numerics.jit import jit
from ..numerics.simd import WIDE
from ..numerics.workspace import after, layout, size_of, start_of, take_integers, take_matrix, take_vector
from .blocks import regression_at, transform_at
from .forecast import forecast_at
from .local_transform import local_at
from .localisation import crews, localised
from .shared import THREADED_FROM, members


def side_of(options: Options, ny: int) -> int:
    """Rows of the largest matrix that an analysis factors."""
    return ny if options.get("radius", 0.0) > 0 else min(ny, members(options))


class Analysis(NamedTuple):
    """What an analysis works in, of N members and ny rows, with matrices of order `side`, the smaller of the two.

    ZT (ny, N) and Z (N, ny) are the whitened anomalies of the expected reading, d (ny,) the whitened innovation, r
    (ny,) variances whose product is det R; `rows` (ny,) says which row of the reading each is, `places` (ny,) the other
    way round. G and U (side, side) are a Gram matrix and the Cholesky factor of I + G. The others are a filter's own: B
    (ny, N + 1), V (side, side), values (side,), small (3 side,), v (ny + N,), T (N, N) and W (N, N + 1). expected (ny,)
    is scratch.
    """

    ZT: Any
    Z: Any
    B: Any
    G: Any
    U: Any
    V: Any
    W: Any
    T: Any
    d: Any
    r: Any
    rows: Any
    expected: Any
    v: Any
    places: Any
    values: Any
    small: Any
    end: int


@layout
def analysis_at(at, N, ny, side):
    """Lay it out."""
    ZT, at = take_matrix(at, ny, N)
    Z, at = take_matrix(at, N, ny)
    B, at = take_matrix(at, ny, N + 1)
    G, at = take_matrix(at, side, side)
    U, at = take_matrix(at, side, side)
    V, at = take_matrix(at, side, side)
    W, at = take_matrix(at, N, N + 1)
    T, at = take_matrix(at, N, N)
    d, at = take_vector(at, ny)
    r, at = take_vector(at, ny)
    rows, at = take_integers(at, ny)
    expected, at = take_vector(at, ny)
    v, at = take_vector(at, ny + N)
    places, at = take_integers(at, ny)
    values, at = take_vector(at, side)
    small, at = take_vector(at, 3 * side)
    return Analysis(ZT, Z, B, G, U, V, W, T, d, r, rows, expected, v, places, values, small, at)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the analysis, and for each crew what the largest of its tasks takes."""
    N, side = members(options), side_of(options, ny)
    crew = max(
        size_of(forecast_at, nx, nx if nx <= LARGE else 0),
        size_of(transform_at, N, WIDE),
        size_of(regression_at, N, WIDE),
        size_of(local_at, N, ny, min(ny, N)),
    )
    return size_of(analysis_at, N, ny, side) + crews(N * nx, THREADED_FROM) * crew


@jit
def begin_analysis(context, sensor, N, work):
    """The workspace of an analysis of one sensor's reading, and the rest of the scratch, which is the crews'."""
    _, ny = sensor_rows(context, sensor)
    a = analysis_at(start_of(work), N, ny, ny if localised(context) else min(ny, N))
    return a, after(work, a.end)


@jit
def find_places(m, rows, places):
    """For each row of a reading which of the m finite ones it is, or -1."""
    for k in range(places.size):
        places[k] = -1
    for k in range(m):
        places[rows[k]] = k
