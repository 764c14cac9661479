"""Scores of a fold: NIS with its bounds, errors where the truth is known, predictions of held-out sensors.

The log-likelihood includes rejected measurements (`log_density`); otherwise it would prefer filters that reject more.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import betainc, gammaln

from ..compiled.verdict import LOG_2PI
from ..log import READING, Events
from ..model.state_space import StateSpaceModel
from ..numerics.quantiles import chi_square_quantile, normal_quantile
from ..track import (
    ADVISORY,
    DEGRADED,
    DIVERGED,
    GATED,
    HEALTH_NAMES,
    MISSING,
    STALE,
    SUSPECT,
    TRACKING,
    USED,
    VERDICT_NAMES,
    Track,
)
from .calibration import LIMITS
from .consistency import NisVerdict
from .field_pictures import Picture
from .health import MAX_ROWS_PER_READING, MEAN, PROBABILITY, HealthPolicy, nis_bounds, normal_nis
from .intervals import scale_interval
from .references import WITHHELD, held_out_references, true_states

BASELINE_CLIP_SIGMA = 6.0  # σ at which the innovations of a row are clipped in a baseline (episodes/baseline.py)
MAX_EXACT_NIS = 1e12  # NIS up to which rounding leaves an error of log |S| below 1e-3
MAX_NIS_FACTOR = (1.0 + LIMITS.width) ** 2  # bands that are wrong by as much as the calibration reports


class Fit(NamedTuple):
    """RMSE and mean error in the quantity's unit, and share of errors inside their 95 % band.

    An error is estimate minus truth, or prediction minus measurement.
    """

    rmse: float
    coverage: float
    bias: float = np.nan


class Score(NamedTuple):
    """Mean NIS of the used measurements with its 95 % bounds, log-likelihoods, counts, and fits.

    log_likelihood: of used and rejected measurements; log_likelihood_used: of the used ones, comparable only between
    filters that reject none. Failed measurements are in neither, as they have no density. refused: share of rejections
    among the gate's verdicts; NaN without any.

    states: fits against the truth, by state; held_out: fits of held-out measurements, by sensor row; field: fit of all
    cells of a large field at the times of its true values, or None.
    """

    nis_verdict: NisVerdict
    nis_readings: int
    log_likelihood: float
    log_likelihood_used: float
    readings: int
    gated: int
    refused: float
    missing: int
    states: dict[str, Fit]
    held_out: dict[str, Fit]
    field: Fit | None = None

    @property
    def nis(self) -> float:
        """Mean NIS of the used measurements."""
        return self.nis_verdict.nis

    @property
    def nis_low(self) -> float:
        """Lower end of its 95 % bounds."""
        return self.nis_verdict.low

    @property
    def nis_high(self) -> float:
        """Upper end of its 95 % bounds."""
        return self.nis_verdict.high

    @property
    def log_likelihood_reading(self) -> float:
        """Log-likelihood of a measurement, used or rejected, which compares runs of different length."""
        judged = self.nis_readings + self.gated
        return self.log_likelihood / judged if judged else np.nan


def score(
    track: Track,
    events: Events,
    model: StateSpaceModel,
    pictures: Sequence[Picture] = (),
    *,
    gate: float | None = None,
    baseline: np.ndarray | None = None,
) -> Score:
    """Return the score of a track. Errors are taken at truth events, whose rows hold the estimate at that time.

    Args:
        track: The track.
        events: Its events.
        model: The model.
        pictures: Pictures of a large field, of which a track has a few cells only.
        gate: Gate of the tuning, the probability that a good measurement passes, which enters the density of rejected
            measurements. Without it, their log-likelihood is NaN.
        baseline: Baseline of the tuning, by which the NIS is judged.
    """
    used = track.verdict == USED
    count, verdicts = int(used.sum()), np.bincount(track.verdict, minlength=len(VERDICT_NAMES))
    gated = int(verdicts[GATED])
    likelihood = float(track.log_likelihood[used].sum())
    held_out = {}
    for item in (item for s in range(len(model.sensors)) for item in held_out_references(model, events, track, s)):
        finite = np.isfinite(item.error)
        if finite.any():
            held_out[item.name] = _fit(-item.error[finite], item.std[finite])
    return Score(
        nis_verdict=nis_verdict(track, events, model, baseline),
        nis_readings=count,
        log_likelihood=likelihood + float(log_density(track.select(track.verdict == GATED), gate).sum()),
        log_likelihood_used=likelihood,
        readings=int((events.kind == READING).sum()),
        gated=gated,
        refused=gated / (gated + count) if gated + count else np.nan,
        missing=int(verdicts[MISSING]),
        states={item.name: _fit(-item.error, item.std) for item in true_states(model, events, track)},
        held_out=held_out,
        field=_over_field(pictures),
    )


def nis_verdict(track: Track, events: Events, model: StateSpaceModel, baseline: np.ndarray | None = None) -> NisVerdict:
    """Return the verdict on the mean NIS of the used measurements of a track; args as of `score`.

    All commands, the page and the report take bounds and verdict from here. With m_t degrees of freedom of measurement
    t and E its expected NIS (m_t, or what the baseline says), the mean NIS divided by the mean of E is r, and

        r ± t(B) √(Ω / n),   Ω: long-run variance of (NIS_t - r E_t) / mean E,

    is its interval (`intervals.scale_interval`). The bounds are those r for which the interval contains 1. If the
    innovations are white and Gaussian, Ω = 2 / mean E, and the bounds are those of chi-square. Those are wrong for
    innovations that are correlated or have outliers, as the variance of their mean is larger: of a filter with the
    right covariance they then reject more than 5 %. So the bounds are the wider of both. Correlation itself is
    reported with the calibration. The bounds never exceed an error of the band width that the calibration reports, as
    a few large outliers would allow for any NIS.

    Sources: Bar-Shalom, Li & Kirubarajan (2001), 5.4.2, for chi-square; Lazarus, Lewis, Stock & Watson (2018),
    doi:10.1080/07350015.2018.1506926, for the interval.
    """
    used = track.verdict == USED
    rows = used if baseline is None else used | (track.verdict == GATED)
    count = int(rows.sum())
    if not count:
        return NisVerdict(np.nan, np.nan, np.nan, baseline is not None)
    channel, free = events.channel[rows], track.dof[rows]
    dof = np.bincount(channel, free, len(model.sensors))
    normal = None if baseline is None else normal_nis(model, baseline)
    nis, each = (float(column[used].mean()) if used.any() else np.nan for column in (track.nis, track.dof))
    expected = free if normal is None else free * normal[channel, MEAN]
    squares, judged = track.nis[rows], np.nan
    if baseline is not None:
        with np.errstate(all="ignore"):
            e = track.innovation[rows] / track.innovation_std[rows]
        e = np.where(np.isfinite(track.whitened[rows]), track.whitened[rows], e)
        squares = np.nansum(np.clip(e, -BASELINE_CLIP_SIGMA, BASELINE_CLIP_SIGMA) ** 2, axis=1)
        judged = float(squares.mean())
    white = nis_bounds(dof, count, normal)
    factor, middle = _correlated_factor(squares, expected), float(expected.mean())
    low, high = min(white[0], middle / factor), max(white[1], middle * factor)
    return NisVerdict(nis, low, high, baseline is not None, judged, each if used.any() else 1.0, *white)


def _correlated_factor(squares: np.ndarray, expected: np.ndarray) -> float:
    """Return by which factor the mean of squares may differ from the expected mean by chance, at least 1.

    Args:
        squares: NIS of each measurement, (n,).
        expected: Their expected values.
    """
    middle = float(expected.mean())
    with np.errstate(all="ignore"):
        r = squares.mean() / middle
        found = scale_interval((squares - r * expected) / middle + r)
        factor = np.divide(found.high, found.value)
    return float(min(factor, MAX_NIS_FACTOR)) if factor > 1.0 else 1.0


def _over_field(pictures: Sequence[Picture]) -> Fit | None:
    known = [picture for picture in pictures if picture.cells]
    if not known:
        return None
    cells = np.array([picture.cells for picture in known], float)
    square = np.average([picture.rmse**2 for picture in known], weights=cells)
    return Fit(float(np.sqrt(square)), float(np.average([picture.inside for picture in known], weights=cells)))


def _fit(error: np.ndarray, std: np.ndarray) -> Fit:
    half = normal_quantile(0.5 + PROBABILITY / 2.0)
    inside = float(np.mean(np.abs(error) <= half * std))
    return Fit(float(np.sqrt(np.mean(error**2))), inside, float(np.mean(error)))


def log_density(refused: Track, gate: float | None) -> np.ndarray:
    """Return the log density of rejected measurements, (N,), in the units of the rows.

    The density outside the gate is the tail of a multivariate Cauchy density, scaled to the probability 1 - P.

    Args:
        refused: Rows of a track with rejected measurements.
        gate: P of the tuning.

    Returns:
        -inf where a NIS is not finite, NaN without a gate.
    """
    if gate is None:
        return np.full(len(refused), np.nan)
    m = np.asarray(refused.dof, float)
    # Of t: log Γ((m + 1) / 2) - ½ log π - ½ m log π - ½ log |S| - ½ (m + 1) log(1 + NIS)
    constant = gammaln(0.5 * (m + 1.0)) - 0.5 * (m + 1.0) * np.log(np.pi)
    with np.errstate(all="ignore"):
        # The log-likelihood of a rejected measurement is log N(ν; 0, S) = -½ (NIS + log |S| + m log 2π).
        log_scale = -refused.log_likelihood - 0.5 * (refused.nis + m * LOG_2PI)
        diagonal = np.nansum(np.log(refused.innovation_std), axis=1)
        log_scale = np.where((m > 1.0) & (refused.nis < MAX_EXACT_NIS), log_scale, diagonal)
        cauchy = constant - log_scale - 0.5 * (m + 1.0) * np.log1p(refused.nis)
    # F(m, 1) exceeds g / m with the probability I(1 / (1 + g); ½, m / 2).
    beyond = betainc(0.5, 0.5 * m, 1.0 / (1.0 + chi_square_quantile(gate, m)))
    found = np.log1p(-gate) + cauchy - np.log(beyond)
    return np.where(np.isfinite(found), found, -np.inf)


def spread_ratio(track: Track, window: int) -> float:
    """Return predicted over actual variance of the innovations of the last `window` used or rejected measurements.

    1 / mean(ν² / S) over their rows: below 1 the spread is too small, above 1 too large. NaN without any.
    """
    verdict = track.verdict[-MAX_ROWS_PER_READING * window :]
    rows = np.flatnonzero((verdict == USED) | (verdict == GATED))[-window:] + len(track) - verdict.size
    e = track.innovation[rows] / track.innovation_std[rows]
    e = e[np.isfinite(e)]
    square = float(np.mean(e * e)) if e.size else np.nan
    return 1.0 / square if square > 0.0 else np.nan


def health_of(events: Events, track: Track, policy: HealthPolicy, hidden: np.ndarray | None = None) -> dict[str, float]:
    """Return the share of time in each state of health, and as `withheld` that of the rows `hidden` (n,), if given.

    A state holds until the next event. Where that is long after the last measurement, the twin is degraded and then
    stale from the times of its policy on, as a running one is; a recording has no event then.
    """
    held = np.diff(events.t, append=events.t[-1:]) * 1e-9
    if not held.any():
        held = np.ones(len(events))
    total, covered = held.sum(), 0.0 if hidden is None else held[hidden].sum()
    held = held if hidden is None else np.where(hidden, 0.0, held)
    seconds = np.bincount(track.health, held, len(HEALTH_NAMES))
    later = held
    for limit, code, better in (
        (policy.stale_after, STALE, (TRACKING, ADVISORY, SUSPECT, DEGRADED, DIVERGED)),
        (policy.degraded_after, DEGRADED, (TRACKING, ADVISORY, SUSPECT)),
    ):
        # Of the time that a row holds, that beyond the limit; what is stale is not degraded as well.
        beyond = np.clip(track.age + later - limit, 0.0, later) * np.isin(track.health, better)
        seconds -= np.bincount(track.health, beyond, len(HEALTH_NAMES))
        seconds[code] += beyond.sum()
        later = later - beyond
    found = dict(zip(HEALTH_NAMES, (np.maximum(seconds, 0.0) / total).tolist(), strict=True))
    return found if hidden is None else found | {WITHHELD: float(covered / total)}
