"""Verdict on a mean NIS against its bounds (`score.nis_verdict`), in words; NEES."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from ..errors import EstimatorError
from ..events.batch import TRUTH, Events, truth_of
from ..model.state_space import StateSpaceModel
from ..numerics.linalg import wrapped
from ..numerics.quantiles import chi_square_quantile
from ..track import Track
from .health import PROBABILITY
from .intervals import scale_interval

MIN_DECIMALS, MAX_DECIMALS = 2, 7  # decimals of a NIS per degree of freedom in words
MAX_DECIMAL_NIS = 1e6  # NIS per degree of freedom from which on it is written with an exponent


class NisVerdict(NamedTuple):
    """A mean NIS, its 95 % bounds, and whether these are those of the baseline (`commissioned`).

    A baseline is computed from used and rejected measurements, each row clipped at 6 σ; `judged` is the mean NIS of the
    same, which is compared with the bounds; NaN where that is the NIS itself. `white_low` and `white_high` are the
    bounds of white Gaussian innovations, NaN where these are the bounds. All are per measurement; words give them per
    degree of freedom, of which a measurement has `dof` on average.
    """

    nis: float
    low: float
    high: float
    commissioned: bool
    judged: float = np.nan
    dof: float = 1.0
    white_low: float = np.nan
    white_high: float = np.nan

    @property
    def ratio(self) -> float:
        """Mean NIS per degree of freedom, 1 where the innovations are as large as predicted."""
        return self.nis / self.dof

    @property
    def measure(self) -> float:
        """The mean NIS that is compared with the bounds."""
        return self.judged if np.isfinite(self.judged) else self.nis

    @property
    def place(self) -> str:
        """`inside`, `above` or `below` the bounds; empty without a NIS."""
        return _place(self.measure, self.low, self.high)

    @property
    def ratio_text(self) -> str:
        """Mean NIS per degree of freedom, with the digits of the bounds."""
        return self._texts()[0]

    @property
    def said(self) -> str:
        """Its position relative to the bounds."""
        if not self.place:
            return "no reading to judge"
        _, measure, low, high, white_low, white_high = self._texts()
        own = abs(self.measure - self.nis) < 0.005 * self.nis
        limited = "" if own else f"{measure} with rejected measurements included and outliers limited to 6 σ, "
        of = " of the commissioned baseline" if self.commissioned else ""
        bounds = f"{self.place} {'the' if of else 'its'} 95 % bounds {low} to {high}{of}"
        white = f" ({white_low} to {white_high} for white Gaussian innovations)" if self._differs else ""
        return f"per degree of freedom, {limited}{bounds}{white}"

    @property
    def words(self) -> str:
        """All of it in one line."""
        return f"mean NIS {self.ratio_text} {self.said}" if self.place else self.said

    @property
    def _differs(self) -> bool:
        """Whether the bounds of white Gaussian innovations lead to another verdict."""
        return _place(self.measure, self.white_low, self.white_high) not in ("", self.place)

    def _texts(self) -> list[str]:
        """Return NIS, the compared NIS, bounds and white bounds per degree of freedom, with equal decimals.

        These are two, or more where the compared NIS would read as a bound from which it differs.
        """
        numbers = (self.nis, self.measure, self.low, self.high, self.white_low, self.white_high)
        values = [value / self.dof for value in numbers]
        if not abs(values[0]) < MAX_DECIMAL_NIS:
            return [f"{value:.3g}" for value in values]
        measure, *bounds = values[1:] if self._differs else values[1:4]
        decimals = MIN_DECIMALS
        while decimals < MAX_DECIMALS and any(
            bound != measure and f"{bound:.{decimals}f}" == f"{measure:.{decimals}f}" for bound in bounds
        ):
            decimals += 1
        return [f"{value:.{decimals}f}" for value in values]


def _place(value: float, low: float, high: float) -> str:
    """Return `inside`, `above` or `below`; empty where a number is missing."""
    if not np.isfinite(value + low + high):
        return ""
    return "below" if value < low else "above" if value > high else "inside"


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

    @property
    def mean_bounds(self) -> tuple[float, float]:
        """Bounds of 95 % of the means of a consistent filter whose ε are as correlated in time as these.

        NaN for fewer than 8 times.
        """
        known = np.isfinite(self.value)
        found = scale_interval(self.value[known] / self.dof[known])
        if not found.value > 0.0:
            return np.nan, np.nan
        return found.value / found.high, found.high / found.value


def nees(
    model: StateSpaceModel, events: Events, track: Track, pairs: np.ndarray, states: Sequence[int] | None = None
) -> Nees:
    """Return the NEES at the truth events of a track.

    Args:
        model: The model; errors of circular states wrap.
        events: The folded events, N of them.
        track: Their rows.
        pairs: Pairs of states of the track's covariances, (k, 2); those of `states` are among them.
        states: Indices of the states, which the track shows; None for all.

    Raises:
        EstimatorError: If no truth is known.
    """
    column = {int(j): k for k, j in enumerate(model.shown)}
    place = {frozenset(map(int, pair)): k for k, pair in enumerate(pairs)}
    chosen = [int(j) for j in (model.shown if states is None else states)]
    rows = np.flatnonzero(events.kind == TRUTH)
    # Events of one time are one truth: their rows hold the same estimate.
    last = rows[np.flatnonzero(np.diff(events.t[rows], append=np.iinfo(np.int64).max))]
    error = np.full((len(chosen), last.size), np.nan)
    for k, j in enumerate(chosen):
        told, values = truth_of(events, j)
        error[k, np.searchsorted(last, told)] = values  # of two values for one time the later counts
        error[k] = wrapped(error[k] - track.mean[last, column[j]], model.circular[j])
    known = np.isfinite(error)
    dof = known.sum(axis=0)
    if not dof.any():
        raise EstimatorError("NEES: no true state is known; give some by log.add_truth(seconds, state=values)")
    value = np.full(last.size, np.nan)
    whole = known[:, :1], np.zeros(last.size, int)
    patterns, pattern = whole if known.all() else np.unique(known, axis=1, return_inverse=True)
    for number, mask in enumerate(patterns.T):
        here, index = np.flatnonzero(pattern.reshape(-1) == number), np.flatnonzero(mask)
        P = np.zeros((index.size, index.size, here.size))
        for a, i in enumerate(index):
            P[a, a] = track.std[last[here], column[chosen[i]]] ** 2
            for b, j in enumerate(index[:a]):
                P[a, b] = track.cross[last[here], place[frozenset((chosen[i], chosen[j]))]]
        value[here] = _squares(error[np.ix_(index, here)], P)
    some = dof > 0
    return _bounded(events.t[last[some]] * 1e-9, value[some], dof[some], 1)


def _squares(error: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return squared errors in units of their covariances, (m,); NaN where a covariance has no inverse.

    P = L Lᵀ,  L z = e,  ε = zᵀ z, for all m times at once.

    Args:
        error: Errors, (k, m).
        P: Covariances, (k, k, m), of which the lower triangles count; becomes L.
    """
    k, m = error.shape
    z = np.empty((k, m))
    with np.errstate(all="ignore"):
        for j in range(k):
            square = P[j, j] - np.einsum("im,im->m", P[j, :j], P[j, :j])
            root = np.sqrt(np.where((square > 0.0) & np.isfinite(square), square, np.nan))
            P[j, j] = root
            P[j + 1 :, j] = (P[j + 1 :, j] - np.einsum("pim,im->pm", P[j + 1 :, :j], P[j, :j])) / root
            z[j] = (error[j] - np.einsum("im,im->m", P[j, :j], z[:j])) / root
        return np.asarray(np.einsum("im,im->m", z, z))


def mean_nees(runs: Sequence[Nees | SupportsNees] | Nees | SupportsNees) -> Nees:
    """Return the mean over independent runs (other truths, other noise) at each time, with its narrower bounds.

    Args:
        runs: Estimates of `fold(..., covariance=True)` or `fold_many`, or the NEES of each, `estimates.nees()`.

    Raises:
        EstimatorError: If there is no run, one is something else, or the runs have true values at different times.
    """
    found = [_nees_of(run) for run in ([runs] if isinstance(runs, (Nees, SupportsNees)) else runs)]
    if not found:
        raise EstimatorError("mean_nees: there is no run; give at least one")
    first = found[0]
    for run in found:
        if not (np.array_equal(run.seconds, first.seconds) and np.array_equal(run.dof, first.dof)):
            raise EstimatorError("mean_nees: the runs know other states, or at other times; a mean needs the same ones")
    return _bounded(first.seconds, np.mean([run.value for run in found], axis=0), first.dof, len(found))


@runtime_checkable
class SupportsNees(Protocol):
    """Estimates that know their NEES."""

    def nees(self) -> Nees:
        """Return it."""
        ...


def _nees_of(run: object) -> Nees:
    """Return the NEES of a run."""
    if isinstance(run, Nees):
        return run
    if isinstance(run, SupportsNees):
        return run.nees()
    raise EstimatorError(
        f"mean_nees: a run is of type {type(run).__name__}; give what fold(..., covariance=True) returns, or the list "
        "of fold_many(..., covariance=True)"
    )


def _bounded(seconds: np.ndarray, value: np.ndarray, dof: np.ndarray, runs: int) -> Nees:
    tail = 0.5 * (1.0 - PROBABILITY)
    counts, which = np.unique(dof, return_inverse=True)
    low, high = (chi_square_quantile(share, runs * counts)[which] / runs for share in (tail, 1.0 - tail))
    return Nees(seconds, value, dof, np.asarray(low, float), np.asarray(high, float), runs)
