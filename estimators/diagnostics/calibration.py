"""Calibration of the confidence bands: by how much they are too narrow or too wide, as an effect size.

On a real asset no filter is exactly consistent, and with enough measurements every test is significant. So each figure
is an effect size with a 95 % interval that allows for correlation, and it is reported in words only where the whole
interval lies beyond a size that matters.

A band may be right on average and wrong at times, so coverage is also given by time and by operating point. Beside it
stands the adaptive conformal interval, which needs no Gaussian: with the scores s = |e| of the last measurements it has
the half-width Q(1 - α_t), their quantile, and follows its own errors,

    α_{t+1} = α_t + γ (α - [s_t > Q(1 - α_t)]),

so that over n predictions its coverage is within about 2 / (γ n) of 1 - α, whatever their distribution.

Source: Gibbs & Candès (2021), Adaptive conformal inference under distribution shift, arXiv:2106.00170, (2), prop. 4.1.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from ..events.batch import INPUT, Events
from ..model.state_space import StateSpaceModel
from ..numerics.quantiles import chi_square_quantile, normal_quantile
from ..track import GATED, HELD_OUT, USED, Track
from .intervals import UNKNOWN, Interval, correlation_interval, mean_interval, scale_interval, share_interval
from .references import true_states

BANDS = (0.50, 0.90, 0.95)  # Nominal coverage of the bands


class CalibrationLimits(NamedTuple):
    """Effect sizes that are reported: the whole interval of a figure must lie beyond.

    width: relative error of the width of a band; bias: in σ; correlation: of either sign; refused: share of rejected
    measurements.
    """

    width: float = 0.25
    bias: float = 0.25
    correlation: float = 0.2
    refused: float = 0.05


LIMITS = CalibrationLimits()


class Calibration(NamedTuple):
    """Calibration of the bands of one sensor row or state, in units of its band, σ.

    e is innovation / S^½ for a row, (truth - estimate) / std for a state. ratio: mean of e², 1 if the band is right;
    scale: its root, the factor by which the bands should be wider. bias: mean of e. correlation: lag 1. refused: share
    of rejected measurements. coverage: shares inside the bands `BANDS`. A held-out sensor has `coverage` alone, a state
    neither `correlation` nor `refused`. words: sentences on the figures beyond their limits.

    start, end: times of the first and the last of n values, s.
    """

    subject: str
    role: str
    start: float
    end: float
    n: int
    ratio: Interval
    scale: Interval
    bias: Interval
    correlation: Interval
    refused: Interval
    coverage: tuple[Interval, ...]
    words: tuple[str, ...]


def calibrations(
    model: StateSpaceModel,
    events: Events,
    track: Track,
    *,
    gate: float | None = None,
    marginal: bool = False,
    limits: CalibrationLimits = LIMITS,
) -> list[Calibration]:
    """Return the calibration of every sensor row with measurements; held-out ones have entries of their own.

    e of a rejected measurement is clipped at the gate: unclipped, one spike would dominate; without it, the figures
    would not contain the rejections. The mean of e² is divided by its value after clipping in a consistent filter.

    Args:
        model: The model.
        events: The folded events, or a window of them.
        track: Their rows of the track.
        gate: Gate of the tuning; None without one.
        marginal: Whether the filter's predictions are not Gaussian, so that `Track.whitened` holds each row by itself.
        limits: Effect sizes to report.
    """
    found = []
    limit = chi_square_quantile(gate, np.arange(1, model.width + 1)) if gate is not None else None
    for name, role, rows, e in _sensor_rows(model, events, track, marginal):
        if role == "used":
            edge = np.full(rows.size, np.inf) if limit is None else np.sqrt(limit[track.dof[rows] - 1])
            found.append(_of_row(name, events.t[rows], e, edge, track.verdict[rows] == GATED, limits))
        else:
            found.append(_held_out(name, events.t[rows], e, limits))
    return found


def truth_calibration(
    model: StateSpaceModel, events: Events, track: Track, *, limits: CalibrationLimits = LIMITS
) -> list[Calibration]:
    """Return the calibration of every state with a known truth, except a discrete mode, which has no band.

    `ratio` is the state's NEES. Args: see `calibrations`.
    """
    found = []
    for name, role, rows, e in _true_states(model, events, track):
        coverage, verdicts = _coverage(e, limits)
        ratio, bias = scale_interval(e**2), mean_interval(e)
        said = truth_words(name, verdicts, bias, limits)
        window = _window(events.t[rows])
        found.append(Calibration(name, role, *window, ratio, _root(ratio), bias, UNKNOWN, UNKNOWN, coverage, said))
    return found


def standardised(track: Track, row: int, marginal: bool) -> np.ndarray:
    """Return e of one row of each event's sensor, (N,), N(0, 1) for a consistent filter; NaN where there is none.

    Innovations over their standard deviations, or with `marginal` normal scores of the predictive distribution.
    """
    with np.errstate(all="ignore"):
        e: np.ndarray = track.innovation[:, row] / track.innovation_std[:, row]
    own = track.whitened[:, row]
    return np.where(np.isfinite(own), own, e) if marginal else e


def _of_row(
    name: str, t: np.ndarray, e: np.ndarray, edge: np.ndarray, refused: np.ndarray, limits: CalibrationLimits
) -> Calibration:
    coverage, _ = _coverage(e, limits)
    clipped = np.clip(e, -edge, edge)
    # E min(z², g²) of a normal z: that of z² inside, and g² outside.
    edge = np.minimum(edge, 40.0)
    tail = 2.0 * ndtr(-edge)
    left = 1.0 - tail - 2.0 * edge * np.exp(-0.5 * edge**2) / np.sqrt(2.0 * np.pi) + edge**2 * tail
    ratio = scale_interval(clipped**2 / left)
    scale, bias, correlation = _root(ratio), mean_interval(clipped), correlation_interval(clipped)
    share = share_interval(refused, clipped)
    words = reading_words(name, scale, bias, correlation, share, limits)
    return Calibration(name, "used", *_window(t), ratio, scale, bias, correlation, share, coverage, words)


def _held_out(name: str, t: np.ndarray, e: np.ndarray, limits: CalibrationLimits) -> Calibration:
    coverage, verdicts = _coverage(e, limits)
    words = tuple(
        f"{name}: {_share(share)} of its readings in the {100 * band:.0f} % band of the prediction{_wide(band, share)}"
        for band, share in verdicts[:1]
    )
    unknown = UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN
    return Calibration(name, "held out", *_window(t), *unknown, coverage, words)


def _coverage(e: np.ndarray, limits: CalibrationLimits) -> tuple[tuple[Interval, ...], Sequence[BandVerdict]]:
    """Return the shares inside the bands, and the bands whose share is beyond the limits, the widest first."""
    shares, verdicts = [], []
    for band in BANDS:
        half = normal_quantile(0.5 + 0.5 * band)
        share = share_interval(np.abs(e) <= half, e)
        low, high = (
            float(2.0 * ndtr(half * width) - 1.0) for width in (1.0 / (1.0 + limits.width), 1.0 + limits.width)
        )
        shares.append(share)
        if share.beyond(low, high):
            verdicts.append(BandVerdict(band, share))
    return tuple(shares), verdicts[::-1]


def _root(ratio: Interval) -> Interval:
    return Interval(*(float(np.sqrt(value)) for value in ratio))


def _window(t: np.ndarray) -> tuple[float, float, int]:
    return float(t[0]) * 1e-9, float(t[-1]) * 1e-9, int(t.size)


class BandVerdict(NamedTuple):
    """Nominal coverage of a band, and its actual coverage, which is beyond the limits."""

    band: float
    share: Interval


FRACTIONS = (
    (0.225, "a fifth"),
    (0.29, "a quarter"),
    (0.415, "a third"),
    (0.58, "a half"),
    (0.7, "two thirds"),
    (0.85, "three quarters"),
)
"""Fractions in words, each up to the middle between it and the next."""


def reading_words(
    name: str, scale: Interval, bias: Interval, correlation: Interval, refused: Interval, limits: CalibrationLimits
) -> tuple[str, ...]:
    """Describe the calibration of a sensor in use, as far as it is beyond the limits."""
    said = []
    if scale.beyond(1.0 / (1.0 + limits.width), 1.0 + limits.width):
        said.append(f"{name}: bands {_off(scale.value)} (scale {_figures(scale, '.2f')})")
    if bias.beyond(-limits.bias, limits.bias):
        side = "above" if bias.value > 0.0 else "below"
        said.append(f"{name}: reads {side} the prediction (bias {_figures(bias, '+.2f')} σ)")
    if correlation.beyond(-limits.correlation, limits.correlation):
        why = "Q too small, or a state is missing" if correlation.value > 0.0 else "Q too large"
        said.append(f"{name}: innovations are correlated ({_figures(correlation, '+.2f')}): {why}")
    if refused.beyond(0.0, limits.refused):
        said.append(f"{name}: the gate rejects {_share(refused)} of the measurements")
    return tuple(said)


def truth_words(
    name: str, verdicts: Sequence[BandVerdict], bias: Interval, limits: CalibrationLimits
) -> tuple[str, ...]:
    """Describe the calibration of a state, as far as it is beyond the limits."""
    said = [
        f"{name}: truth in its {100 * band:.0f} % band {_share(share)} of the time{_wide(band, share)}"
        for band, share in verdicts[:1]
    ]
    if bias.beyond(-limits.bias, limits.bias):
        side = "above" if bias.value > 0.0 else "below"
        said.append(f"{name}: truth {side} the estimate (bias {_figures(bias, '+.2f')} σ)")
    return tuple(said)


def _off(scale: float) -> str:
    """Describe the error of bands that should be `scale` times as wide."""
    if not scale > 0.0:
        return "far too wide: the readings never differ from the prediction"
    factor, side = (scale, "too narrow") if scale > 1.0 else (1.0 / scale, "too wide")
    fraction = next((word for limit, word in FRACTIONS if factor - 1.0 < limit), None)
    return f"{fraction} {side}" if fraction else f"{side} by a factor of {factor:.2g}"


def _figures(figure: Interval, form: str) -> str:
    """Return value, low and high as text."""
    value, low, high = (format(number, form) for number in figure)
    return f"{value}, {low} to {high}"


def _wide(band: float, share: Interval) -> str:
    return ", too wide" if share.value > band else ""


def _share(share: Interval) -> str:
    return f"{100 * share.value:.3g} % ({100 * share.low:.3g} to {100 * share.high:.3g})"


WHOLE, TIME = "whole log", "time"
"""Values of `CoverageBin.by` other than names of states and inputs."""

HOUR_S = 3600.0
MIN_HOURS, MAX_HOURS = 3, 48  # Lengths of a log that is divided into hours
TENTHS = 10  # Parts of a shorter or longer log
OPERATING_BINS = 5  # Bins of a state or an input, with equally many measurements
MAX_SUBJECTS = 40  # Rows and states whose coverage is divided
MAX_OPERATING = 12  # States and inputs by which it is divided
MAX_COVERED = 20_000  # Measurements of a row or state that count; of more, evenly spaced ones
ADAPTIVE_RATE = 0.005  # γ
ADAPTIVE_WINDOW, MIN_ADAPTIVE = 500, 40  # Most and fewest scores of a quantile
BAND = BANDS[-1]

LOW_COVERAGE = float(2.0 * ndtr(normal_quantile(0.5 + 0.5 * BAND) / (1.0 + LIMITS.width)) - 1.0)
"""Coverage of a band that is too narrow by the size that matters."""


class CoverageBin(NamedTuple):
    """Coverage of the 95 % bands of one sensor row or state in one part of a log.

    by: `WHOLE`, `TIME` (low and high in s), or the state or input whose value lies between low and high. coverage:
    share of n values inside, with an interval that allows for correlation. adaptive: share inside the adaptive
    conformal interval, whose median half-width is `factor` times that of the band; NaN where it has too few values.
    """

    subject: str
    role: str
    by: str
    low: float
    high: float
    n: int
    coverage: Interval
    adaptive: float
    factor: float


def held_inputs(model: StateSpaceModel, events: Events) -> np.ndarray:
    """Return the inputs that hold at each event, (n, nu); NaN before the first of each."""
    found = np.where((events.kind == INPUT)[:, None], events.value[:, : model.nu], np.nan)
    last = np.where(np.isfinite(found), np.arange(len(events))[:, None], 0)
    np.maximum.accumulate(last, axis=0, out=last)
    return np.take_along_axis(found, last, axis=0)


def coverage_bins(
    model: StateSpaceModel,
    events: Events,
    track: Track,
    inputs: np.ndarray,
    *,
    marginal: bool = False,
    most: int = MAX_COVERED,
) -> list[CoverageBin]:
    """Return the coverage of one-step predictions, held-out sensors and true states, by time and operating point.

    Args:
        model: The model; of more than `MAX_SUBJECTS` rows and true states the first are divided.
        events: The folded events, or a window of them.
        track: Their rows of the track.
        inputs: Inputs that hold at each event (n, nu), see `held_inputs`.
        marginal: As in `calibrations`.
        most: Measurements of a row or state that count.
    """
    before = np.maximum(np.arange(len(events)) - 1, 0)
    # The estimate before the measurement, which must not sort its own innovation.
    points = {state.name: track.mean[before, k] for k, state in enumerate(model.shown_states[:MAX_OPERATING])}
    points |= {item.name: inputs[:, k] for k, item in enumerate(model.inputs[:MAX_OPERATING])}
    found: list[CoverageBin] = []
    subjects = chain(_sensor_rows(model, events, track, marginal), _true_states(model, events, track))
    for subject, role, rows, e in islice(subjects, MAX_SUBJECTS):
        step = -(-rows.size // most)
        rows, e = rows[::step], e[::step]
        seconds = events.t[rows] * 1e-9
        half = normal_quantile(0.5 + 0.5 * BAND)
        inside, widths = np.abs(e) <= half, adaptive_widths(e)
        parts = [(WHOLE, float(seconds[0]), float(seconds[-1]), np.ones(rows.size, bool))]
        parts += _parts(TIME, seconds, _time_edges(events.t[0] * 1e-9, events.t[-1] * 1e-9))
        for name, values in points.items():
            own = values[rows]
            parts += _parts(name, own, _operating_edges(own)) if name != subject or role != "truth" else []
        for by, low, high, mask in parts:
            n, width = int(mask.sum()), widths[mask]
            known = np.isfinite(e[mask]) & ~np.isnan(width)
            adaptive = float(np.mean(np.abs(e[mask])[known] <= width[known])) if known.any() else np.nan
            factor = float(np.median(width[known])) / half if known.any() else np.nan
            coverage = share_interval(inside[mask], e[mask])
            found.append(CoverageBin(subject, role, by, low, high, n, coverage, adaptive, factor))
    return found


Subject = tuple[str, str, np.ndarray, np.ndarray]
"""Name, role, rows (m,) and e (m,) of a quantity with a band."""


def _sensor_rows(model: StateSpaceModel, events: Events, track: Track, marginal: bool) -> Iterator[Subject]:
    """Yield each sensor row, used and held out."""
    for i, (sensor, start) in enumerate(zip(model.sensors, model.row_start, strict=True)):
        own = events.of_sensor(i)
        for k in range(len(sensor.rows)):
            e = standardised(track, k, marginal)[own]
            for role, verdicts in (("used", (USED, GATED)), ("held out", (HELD_OUT,))):
                there = np.isfinite(e) & np.isin(track.verdict[own], verdicts)
                if there.any():
                    yield model.row_names[start + k], role, own[there], e[there]


def _true_states(model: StateSpaceModel, events: Events, track: Track) -> Iterator[Subject]:
    """Yield each state with a known truth, except a discrete mode."""
    for item in true_states(model, events, track):
        with np.errstate(all="ignore"):
            e = item.error / item.std
        known = np.isfinite(e)
        if known.any() and not (model.jump and item.name == model.jump.state):
            yield item.name, "truth", item.rows[known], e[known]


def _time_edges(first: float, last: float) -> np.ndarray:
    """Return the edges of hours since the start, or of tenths of a log shorter or longer than that, s."""
    hours = (last - first) / HOUR_S
    if MIN_HOURS <= hours <= MAX_HOURS:
        return first + HOUR_S * np.arange(np.ceil(hours) + 1.0)
    return np.linspace(first, last, TENTHS + 1)


def _operating_edges(values: np.ndarray) -> np.ndarray:
    """Return the edges of bins with about equally many values (n,), or of a bin for each of few levels."""
    known = values[np.isfinite(values)]
    if not known.size:
        return np.zeros(0)
    levels = np.unique(known)
    if 1 < levels.size <= OPERATING_BINS:
        return np.append(levels, levels[-1])
    edges = np.unique(np.quantile(known, np.linspace(0.0, 1.0, OPERATING_BINS + 1)))
    return edges if edges.size > 2 else np.zeros(0)


def _parts(by: str, values: np.ndarray, edges: np.ndarray) -> list[tuple[str, float, float, np.ndarray]]:
    """Return name, ends and mask (n,) of each bin that has values; the last one contains its upper end."""
    found = []
    for k, (low, high) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        mask = (values >= low) & ((values < high) | (k == edges.size - 2) & (values <= high))
        if mask.any():
            found.append((by, low, high, mask))
    return found


def adaptive_widths(e: np.ndarray) -> np.ndarray:
    """Return the half-width of the adaptive conformal interval before each of e (n,), in σ.

    NaN for the first `MIN_ADAPTIVE`; infinite where it has missed too often.
    """
    found = np.full(e.size, np.nan)
    recent, ordered, alpha = deque[float](), list[float](), 1.0 - BAND
    for k, score in enumerate(np.abs(e).tolist()):
        if len(ordered) >= MIN_ADAPTIVE:
            place = int(np.ceil((1.0 - alpha) * (len(ordered) + 1)))
            width = np.inf if place > len(ordered) else ordered[place - 1] if place > 0 else 0.0
            found[k] = width
            alpha += ADAPTIVE_RATE * (1.0 - BAND - float(score > width))
        insort(ordered, score)
        recent.append(score)
        if len(recent) > ADAPTIVE_WINDOW:
            del ordered[bisect_left(ordered, recent.popleft())]
    return found
