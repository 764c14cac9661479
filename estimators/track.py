"""The track: the results of a fold, one row per event of the log."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import register_jitable

from .numerics.jit import B1, F1, F2, I1, borrowed

NONE, USED, GATED, HELD_OUT, MISSING, FAILED, SCREENED = range(7)
"""Verdict on an event: not a measurement; used; rejected by the gate; held out and scored; no finite row; failed, as S
was not positive definite beyond rounding or the NIS not finite; rejected before the filter."""

VERDICT_NAMES = ("none", "used", "gated", "held out", "missing", "failed", "screened")

REASONS = ("range", "rate", "stuck", "saturated", "duplicate")
"""Reasons for which a row of a measurement is rejected before the filter: out of range; changes too fast; repeats
itself; saturated converter; a measurement that arrived before. Bits of `Track.screened`, in this order."""

RANGE, RATE, REPEATED, SATURATED, DUPLICATE = (1 << k for k in range(len(REASONS)))
NO_VALUE = RANGE | RATE  # Reasons for which a row tells nothing of its sensor, not even that its value has changed

HEALTH_NAMES = ("waiting", "tracking", "advisory", "suspect", "degraded", "diverged", "stale")
WAITING, TRACKING, ADVISORY, SUSPECT, DEGRADED, DIVERGED, STALE = range(len(HEALTH_NAMES))
"""Health: no measurement has arrived; consistent; conservative, as bands are wider than necessary or the gate rejects
outliers; overconfident or wrong; a sensor is lost or measurements are late; the estimate is lost; no data."""

USABLE = (TRACKING, ADVISORY)  # Health in which estimate and band hold

LOG_LIKELIHOOD = 2
"""Index of the log-likelihood in a filter's scores."""

EFFECTIVE, ANCESTORS, WHITENED = range(3, 6)
"""Indices in a filter's scores, after NIS, degrees of freedom and log-likelihood, of the effective sample size and the
number of ancestors, and of the first whitened row of the measurement."""


class Track(NamedTuple):
    """Columns of one length N.

    mean, std (N, nx): the estimate after the event, in the units of the states. cross (N, pairs): the covariance of
    each configured pair of states. innovation, innovation_std (N, ny): measurement minus prediction and the square
    root of S's diagonal; NaN for other events. nis: νᵀ S⁻¹ ν, `dof` its degrees of freedom. log_likelihood: of a
    rejected measurement always log N(ν; 0, S). nis_mean with nis_low and
    nis_high: mean NIS over the last measurements, and its 95 % bounds. age: seconds since the last measurement that was
    used, gated or failed, or since a reset. consistency: DIVERGED if the window of NIS shows that, else TRACKING.
    whitened (N, ny): the innovation transformed to N(0, I), by row of the measurement; for a prediction that is not
    Gaussian each row by itself, Φ⁻¹(F(y)). alarms (N, width): bits of the causes in alarm after this event, by row of
    the measurement or state of the truth; flags: bits of other conditions (diagnostics/detectors.py).
    screened (N, ny): bits of `REASONS` for which a row of the measurement was rejected before the filter. effective:
    effective sample size of particles after a used measurement, before resampling; ancestors: number of particles some
    measurements ago from which these descend (particle/); NaN elsewhere. factor (N, nx): by how much more than its std
    a state has been corrected, while its memory is in alarm (diagnostics/memory.py), else 1.
    """

    mean: np.ndarray
    std: np.ndarray
    cross: np.ndarray
    innovation: np.ndarray
    innovation_std: np.ndarray
    nis: np.ndarray
    log_likelihood: np.ndarray
    dof: np.ndarray
    verdict: np.ndarray
    age: np.ndarray
    nis_mean: np.ndarray
    nis_low: np.ndarray
    nis_high: np.ndarray
    consistency: np.ndarray
    health: np.ndarray
    whitened: np.ndarray
    alarms: np.ndarray
    flags: np.ndarray
    screened: np.ndarray
    effective: np.ndarray
    ancestors: np.ndarray
    factor: np.ndarray

    @staticmethod
    def allocate(rows: int, nx: int, pairs: int, ny: int, width: int | None = None) -> Track:
        """Allocate columns for `rows` events; a row has values, and memory, once its event is folded."""
        widths = iter((nx, nx, pairs, ny, ny, ny, width or ny, ny, nx))
        shapes = ((rows, next(widths)) if kind.ndim == 2 else rows for kind in track_type.types)
        return Track(*(np.empty(shape, str(kind.dtype)) for shape, kind in zip(shapes, track_type.types, strict=True)))

    def select(self, index: slice | np.ndarray) -> Track:
        """Return the rows that a slice, mask or index array selects."""
        return Track(*(column[index] for column in self))

    def copy(self) -> Track:
        """Return an independent copy."""
        return Track(*(column.copy() for column in self))

    def __len__(self) -> int:
        """Return the number of rows (not of columns)."""
        return int(self.nis.size)


def estimated_rows(track: Track, first: int = 0) -> np.ndarray:
    """Return the mask (n - first,) of rows from `first` on whose estimate is finite in all states."""
    # A sum is finite only if all terms are, and takes a third of the time of `all` along so few columns.
    return np.asarray(np.isfinite(np.einsum("ij->i", track.mean[first:]) + np.einsum("ij->i", track.std[first:])))


def covariances(std: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Return covariances (N, n, n) of deviations (N, n), and the covariances of all pairs i < j in their order."""
    n = std.shape[1]
    cov = np.empty((len(std), n, n))
    cov[:, range(n), range(n)] = std**2
    i, j = np.triu_indices(n, 1)
    cov[:, i, j] = cov[:, j, i] = cross
    return cov


# As in log.py: `len` counts rows, not columns.
Track._make = classmethod(lambda cls, columns: cls(*columns))  # type: ignore[method-assign, assignment]

_A1, _A2, _B2 = types.int32[::1], types.Array(types.int32, 2, "C"), types.Array(types.int8, 2, "C")
track_type = types.NamedTuple(
    (F2, F2, F2, F2, F2, F1, F1, _A1, B1, F1, F1, F1, F1, B1, B1, F2, _A2, I1, _B2, F1, F1, F2), Track
)


_columns = ", ".join(f"borrowed(track.{name})" for name in Track._fields)
borrowed_columns = register_jitable(eval(f"lambda track: Track({_columns})", {"Track": Track, "borrowed": borrowed}))
"""Return the same columns, not reference-counted."""
