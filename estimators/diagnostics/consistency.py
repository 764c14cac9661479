"""Verdict on a mean NIS against its expected value and bounds (`health.normal_nis`), in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from ..errors import EstimatorError
from ..events.batch import TRUTH, Events
from ..model.state_space import StateSpaceModel
from ..numerics.quantiles import chi_square_quantile
from .health import PROBABILITY
from .references import wrapped


class NisVerdict(NamedTuple):
    """A mean NIS, its 95 % bounds, and whether these are those of the baseline (`commissioned`).

    A baseline is computed from used and rejected measurements, each row clipped at 6 σ; `judged` is the mean NIS of the
    same, which is compared with the bounds; NaN where that is the NIS itself.
    """

    nis: float
    low: float
    high: float
    commissioned: bool
    judged: float = np.nan

    @property
    def measure(self) -> float:
        """The mean NIS that is compared with the bounds."""
        return self.judged if np.isfinite(self.judged) else self.nis

    @property
    def place(self) -> str:
        """`inside`, `above` or `below` the bounds; empty without a NIS."""
        if not np.isfinite(self.measure + self.low + self.high):
            return ""
        return "below" if self.measure < self.low else "above" if self.measure > self.high else "inside"

    @property
    def said(self) -> str:
        """Its position relative to the bounds."""
        if not self.place:
            return "no reading to judge"
        bounds = f"{self.place} its 95 % bounds {self.low:.3g} to {self.high:.3g}"
        own = abs(self.measure - self.nis) < 0.005 * self.nis
        clipped = "" if own else f"{self.measure:.3g} with those refused and none beyond 6 σ, "
        return clipped + bounds + (", as commissioned" if self.commissioned else "")

    @property
    def words(self) -> str:
        """All of it in one line."""
        return f"mean NIS {self.nis:.3g}, {self.said}" if self.place else self.said


class Nees(NamedTuple):
    """Normalised estimation error squared, one entry per time with a known truth.

    ε = (x - x̂)ᵀ P⁻¹ (x - x̂), over the `dof` known states; its mean over `runs` runs. `low` and `high` bound 95 % of
    these values if the filter is consistent. NaN where P has no inverse. Values of one run are correlated in time, so
    the mean over time has no bounds.

    Source: Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 5.4.2.
    """

    seconds: np.ndarray
    value: np.ndarray
    dof: np.ndarray
    low: np.ndarray
    high: np.ndarray
    runs: int = 1

    @property
    def mean(self) -> float:
        """Mean of ε per degree of freedom; about 1 if the filter is consistent."""
        return float(np.nansum(self.value) / self.dof[np.isfinite(self.value)].sum())

    @property
    def inside(self) -> float:
        """Share of times with ε inside its bounds."""
        known = np.isfinite(self.value)
        return float(np.mean((self.low <= self.value)[known] & (self.value <= self.high)[known]))


def nees(model: StateSpaceModel, events: Events, mean: np.ndarray, cov: np.ndarray) -> Nees:
    """Return the NEES at the truth events.

    Args:
        model: The model; errors of circular states wrap.
        events: The folded events, N of them.
        mean: Estimates, (N, nx).
        cov: Covariances, (N, nx, nx).

    Raises:
        EstimatorError: If no truth is known.
    """
    times, values, dof = [], [], []
    rows = np.flatnonzero(events.kind == TRUTH)
    circular = model.circular.astype(bool)
    # Events of one time are one truth: their rows hold the same estimate.
    for together in np.split(rows, 1 + np.flatnonzero(np.diff(events.t[rows]))):
        truth = np.full(model.nx, np.nan)
        for i in together:
            first = int(events.channel[i])
            block = events.value[i, : model.nx - first]
            np.copyto(truth[first : first + block.size], block, where=np.isfinite(block))
        known = np.isfinite(truth)
        if not known.any():
            continue
        last = together[-1]
        error = truth - mean[last]
        error[circular] = wrapped(error[circular])
        times.append(events.t[last] * 1e-9)
        values.append(_square(error[known], cov[last][np.ix_(known, known)]))
        dof.append(int(known.sum()))
    if not times:
        raise EstimatorError("NEES: no true state is known; give some by log.add_truth(seconds, state=values)")
    return _bounded(np.array(times), np.array(values), np.array(dof), 1)


def mean_nees(runs: Sequence[Nees]) -> Nees:
    """Return the mean over independent runs (other truths, other noise) at each time, with its narrower bounds.

    Raises:
        EstimatorError: If there is no run, or the runs have true values at different times.
    """
    if not runs:
        raise EstimatorError("mean_nees: there is no run; give at least one")
    first = runs[0]
    for run in runs:
        if not (np.array_equal(run.seconds, first.seconds) and np.array_equal(run.dof, first.dof)):
            raise EstimatorError("mean_nees: the runs know other states, or at other times; a mean needs the same ones")
    return _bounded(first.seconds, np.mean([run.value for run in runs], axis=0), first.dof, len(runs))


def _square(error: np.ndarray, P: np.ndarray) -> float:
    """Return the squared error in units of its covariance; NaN if that has no inverse."""
    try:
        return float(error @ cho_solve(cho_factor(P), error))
    except (LinAlgError, ValueError):
        return np.nan


def _bounded(seconds: np.ndarray, value: np.ndarray, dof: np.ndarray, runs: int) -> Nees:
    tail = 0.5 * (1.0 - PROBABILITY)
    low, high = (chi_square_quantile(share, runs * dof) / runs for share in (tail, 1.0 - tail))
    return Nees(seconds, value, dof, np.asarray(low, float), np.asarray(high, float), runs)
