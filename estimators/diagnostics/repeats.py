"""Detect channels whose rows repeat or interpolate a value until there is a new measurement.

Null hypothesis: each row is a new measurement. A decision takes p < 10⁻⁶ (one-sided binomial, Bonferroni over what was
searched) and an effect size. δ is the step of the grid on which the values lie.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import bdtr, bdtrc

from ..log import READING, Events
from ..model.state_space import StateSpaceModel

HELD, STEPS, DEAD_BAND, LINEAR = "held", "held or set point", "dead band", "interpolated or computed"
SINGLE, UNDECIDED = "", "undecided"

MAX_P = 1e-6
EQUAL = 2.0**-40  # Relative difference below which two values are equal
MIN_CHANGES = 15  # Changes, or bends, that a decision takes
MIN_SIZE = 4.0  # Of δ: changes of at least this size are no rounding
CODE_SIZE, CODE_SHARE = 8.0, 0.5  # Of δ: changes that cluster here are the code of a converter
REPEAT_NULL = 1.0 / (4.0 * np.sqrt(2.0 * np.pi))
"""Largest probability that noise repeats a value after a change of 4δ: the density of a change there, times δ."""
MIN_REPEATED, MIN_PERIODIC, MIN_STRAIGHT = 0.7, 0.8, 0.5  # Effect sizes of the three tests
COARSE_SIZE = 2.5  # Of δ: smaller changes of coarse values count only where they turn back
MIN_TELLING = 0.25  # Share of such changes, below which a smooth course makes them
MAX_PATTERN = 0.9  # Autocorrelation of the changes from which on a pattern repeats itself: a toggle, a sine, a ramp
BEND_SIZE, LINE_NULL = 8.0, 0.1  # Of δ, and the probability that noise puts a row within δ of a chord
MAX_LEVELS = 8  # Values of a switch, of which nothing is decided without a period
WIDTHS = ((0.5, 0.0), (0.6, 0.0), (1.0, 0.0), (1.0, 0.02), (1.0, 0.1))
"""Deviations of a run length from multiples of a period that are tried: in rows, or of the period if that is more."""
MIN_EXACT = 0.9  # Share of the runs of coarse values within such a deviation, and none is shorter
MAX_MULTIPLE = 20.0  # Periods of the longest run that is looked at
MAX_HELD = 0.99  # Share of the holds of one period within the longest one
MAX_CANDIDATES = 5  # Commonest run lengths that are tried as a period
MIN_Z, MIN_HELD, MAX_BETWEEN = 7.0, 0.98, 0.9
"""Of coarse lines: z of the phase of their knots, share of the rows on their chords, and on others."""
MAX_APART, MAX_RANKED = 100, 30_000  # Rows between such knots, and rows in which they are searched


class RepeatFinding(NamedTuple):
    """Whether the rows of a channel are measurements of their own.

    `kind` is HELD (a new value each `period`), STEPS or DEAD_BAND (constant between changes without a period), LINEAR
    (`period` is that of its knots, NaN without one), SINGLE (each row is a measurement) or UNDECIDED. `longest` is the
    longest that a value is held in one period, s; `share` is that of rows which repeat or interpolate, and `reason`
    is the finding in words.
    """

    kind: str
    period: float = np.nan
    longest: float = np.nan
    share: float = 0.0
    reason: str = ""

    @property
    def found(self) -> bool:
        """Whether rows are repeats."""
        return self.kind not in (SINGLE, UNDECIDED)

    @property
    def key(self) -> str:
        """Value of the key `repeats` that keeps the measurements; empty if none does."""
        if self.kind == HELD:
            return f"every {self.longest:.4g} s"
        return "changes" if self.kind in (STEPS, DEAD_BAND) else ""


RECENT = (200, 800, 3200, 12_800, 51_200)
"""Latest values that are searched: a hold is found once it has `MIN_CHANGES` new values in one of these."""


def latest_repeats(t: np.ndarray, values: np.ndarray) -> tuple[int, RepeatFinding]:
    """Return the first time (ns) of the latest values of a channel, and whether these are repeats, as `find_repeats`.

    They are HELD if any number of them in `RECENT` is, and undecided only if all are.
    """
    found = [(int(t[-n:][0]), find_repeats(t[-n:], values[-n:])) for n in RECENT if n < 4 * t.size]
    order = [HELD, SINGLE, STEPS, DEAD_BAND, LINEAR, UNDECIDED]
    return min(found, key=lambda item: order.index(item[1].kind), default=(0, RepeatFinding(UNDECIDED)))


def sensor_rows(model: StateSpaceModel, events: Events) -> Iterator[tuple[str, str, int, np.ndarray]]:
    """Yield sensor, row, its column and the mask (N,) of its measurements, for each sensor row."""
    for k, sensor in enumerate(model.sensors):
        own = (events.kind == READING) & (events.channel == k)
        for column, row in enumerate(sensor.rows):
            yield sensor.name, row.name, column, own & np.isfinite(events.value[:, column])


def find_repeats(t: np.ndarray, values: np.ndarray) -> RepeatFinding:
    """Decide whether rows repeat or interpolate.

    Args:
        t: Times in rising order, ns, (n,).
        values: Finite values, (n,).
    """
    d = np.diff(values)
    d[np.abs(d) <= EQUAL * np.abs(values[1:])] = 0.0
    apart = np.diff(t)
    changes = np.flatnonzero(d)
    if changes.size < MIN_CHANGES or not apart.any():
        return RepeatFinding(UNDECIDED, reason=f"fewer than {MIN_CHANGES} changes")
    # Rows in usual intervals, so that gaps and lost rows do not move the phase, nor do late rows.
    place = np.append(0, np.cumsum(np.maximum(np.rint(apart / np.median(apart[apart > 0])), 1.0))).astype(np.int64)
    step = _grid(values, d)
    repeated = _repeats(values, d, step)
    if repeated is None:
        telling = _turns(d[changes], step)
        changes = changes[telling] if np.mean(telling) >= MIN_TELLING else changes[:0]
    if repeated is not False and (known := _period(place[changes + 1], t[changes + 1], every=repeated is None)):
        if repeated or not _has_pattern(d):
            share = float(np.mean(d == 0.0))
            text = f"new value every {known[0]:.4g} s, repeated in {100.0 * share:.0f} % of rows"
            return RepeatFinding(HELD, *known, share, text)
    if repeated:
        return _steps(values, d, step)
    line = _line(t, values, d, place, step)
    # A hold is possible if few changes are in neighbouring rows.
    held = changes.size < MIN_CHANGES or np.mean(np.diff(place[changes]) == 1) <= 1.0 - MIN_PERIODIC
    if line is None and repeated is None and held:
        return RepeatFinding(UNDECIDED, reason="its values are too coarse")
    return line or RepeatFinding(SINGLE)


def _grid(values: np.ndarray, d: np.ndarray) -> float:
    """Return δ: the smallest step of the commonest values, or the code of a converter."""
    levels, count = np.unique(values, return_counts=True)
    common = np.sort(levels[np.argsort(-count, kind="stable")[: max(2, int(0.9 * levels.size))]])
    steps = np.diff(common)
    steps = steps[steps > EQUAL * np.abs(common[1:])]
    step = float(steps.min()) if steps.size else 0.0
    large = np.abs(d)[np.abs(d) >= MIN_SIZE * step * (1 - 1e-9)]
    if large.size >= MIN_CHANGES:
        code = float(np.median(large))
        near = np.abs(large - code) <= step * (1.0 + 1e-9) + 1e-9 * code
        if code >= CODE_SIZE * step and np.mean(near) >= CODE_SHARE:
            return code
    return step


def _repeats(values: np.ndarray, d: np.ndarray, step: float) -> bool | None:
    """Return whether large changes are followed by an exact repeat; None without enough of them."""
    large = np.abs(d) >= MIN_SIZE * step * (1.0 - 1e-9)
    large &= d != 0.0
    # A row that returns to the value before it is a spike.
    spike = np.append(large[:-1] & large[1:] & (np.abs(values[2:] - values[:-2]) <= step), False)
    spike[1:] |= spike[:-1]
    chosen = np.flatnonzero(large & ~spike)
    chosen = chosen[chosen + 1 < d.size]
    if chosen.size < MIN_CHANGES:
        return None
    count = int(np.count_nonzero(d[chosen + 1] == 0.0))
    return count >= MIN_REPEATED * chosen.size and bool(bdtrc(count - 1, chosen.size, REPEAT_NULL) < MAX_P)


def _turns(changes: np.ndarray, step: float) -> np.ndarray:
    """Return the mask of changes of coarse values that noise of one row makes: large ones, and those that turn back."""
    mask: np.ndarray = np.abs(changes) >= COARSE_SIZE * step
    mask[1:] |= changes[1:] * changes[:-1] < 0.0
    return mask


def _has_pattern(d: np.ndarray) -> bool:
    """Return whether the changes repeat themselves at some lag."""
    half = d.size // 2
    power = np.abs(np.fft.rfft(d, 2 * d.size)) ** 2
    lagged = np.fft.irfft(power)[1 : half + 1] * d.size / np.arange(d.size - 1, d.size - 1 - half, -1)
    return bool(lagged.max(initial=0.0) >= MAX_PATTERN * float(d @ d))


def _period(place: np.ndarray, t: np.ndarray, *, every: bool) -> tuple[float, float] | None:
    """Return the period of changes and the longest time between two neighbours, s; None without a period.

    If runs between changes have any falling distribution, a set A of lengths has at most the probability
    max over n of |A ∩ [1..n]| / n: such a distribution is a mixture of uniform ones on [1..n].

    Args:
        place: Rows of the changes, (n,).
        t: Their times, ns, (n,).
        every: Whether all runs must be multiples of the period, or `MIN_PERIODIC` of them.
    """
    runs = np.diff(place)
    if runs.size < MIN_CHANGES - 1 or not runs.all():
        return None
    lengths, count = np.unique(runs, return_counts=True)
    usual = lengths[np.argsort(-count, kind="stable")[:MAX_CANDIDATES]]
    tests = len(WIDTHS) * usual.size
    for rows, share in WIDTHS:
        for length in usual[usual > 1].tolist():
            period, width = float(length), max(rows, share * length)
            if rows > 0.5:
                period = float(runs[np.abs(runs - length) <= max(1.0, width)].mean())
            for _ in range(2):
                off, multiple = _multiples(runs, period)
                good = off <= width
                if rows > 0.5 and good.any():
                    period = float(runs[good].sum() / multiple[good].sum())
            # A falling distribution falls below any length, too.
            part = runs <= MAX_MULTIPLE * period
            short = period - runs.min() > width + 0.5
            if every and (rows >= 1.0 and period < 5.0 or short or np.mean(good[part]) < MIN_EXACT):
                continue
            n = np.arange(1, int(min(lengths[-1], MAX_MULTIPLE * period)) + 1)
            null = float(np.max(np.cumsum(_multiples(n, period)[0] <= width) / n))
            agreed = int(np.sum(good & part))
            if agreed >= MIN_PERIODIC * part.sum() and tests * bdtrc(agreed - 1, int(part.sum()), null) < MAX_P:
                seconds = np.diff(t)[good] * 1e-9
                once = seconds[multiple[good] == 1.0]
                row = float(np.median(np.diff(t) / runs)) * 1e-9
                found = float(seconds.sum() / multiple[good].sum())
                return found, max(found, float(np.quantile(once, MAX_HELD) if once.size else 0.0) - 0.5 * row)
    return None


def _multiples(runs: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of runs to the next multiple of the period, and these multiples."""
    multiple = np.maximum(np.rint(runs / period), 1.0)
    return np.abs(runs - multiple * period), multiple


def _steps(values: np.ndarray, d: np.ndarray, step: float) -> RepeatFinding:
    """Return the finding for values that are held without a period."""
    if np.unique(values).size <= MAX_LEVELS:
        return RepeatFinding(UNDECIDED, reason=f"{MAX_LEVELS} different values or fewer")
    share, size = float(np.mean(d == 0.0)), np.abs(d[d != 0.0])
    words = f"repeated in {100.0 * share:.0f} % of rows, without a period"
    for q in (0.25, 0.5, 0.75, 1.0):
        # Of a density that falls on both sides of zero, [-x, x] holds at least half of [-2x, 2x].
        wide = size[size < np.quantile(size, q)]
        small = 0.5 * float(wide.max(initial=0.0))
        if small >= MIN_SIZE * step and 4.0 * bdtr(int(np.sum(wide < small)), wide.size, 0.5) < MAX_P:
            return RepeatFinding(DEAD_BAND, np.nan, np.nan, share, f"small changes are left out (dead band), {words}")
    return RepeatFinding(STEPS, np.nan, np.nan, share, f"held or set point, {words}")


def _line(t: np.ndarray, values: np.ndarray, d: np.ndarray, place: np.ndarray, step: float) -> RepeatFinding | None:
    """Return the finding for rows on straight lines between knots; None if they are not."""
    h = np.maximum(np.diff(t).astype(float), 1.0)
    chord = (values[:-2] * h[1:] + values[2:] * h[:-1]) / (h[1:] + h[:-1])
    e = np.abs(values[1:-1] - chord)
    tolerance = max(step, EQUAL * float(np.max(np.abs(values))))
    bends = np.flatnonzero(e[:-1] >= BEND_SIZE * tolerance)
    bends = bends[np.minimum(np.abs(d[bends + 1]), np.abs(d[bends + 2])) > 2.0 * tolerance]
    count = int(np.sum(e[bends + 1] <= tolerance))
    if (
        bends.size < MIN_CHANGES
        or count < MIN_STRAIGHT * bends.size
        or bdtrc(count - 1, bends.size, LINE_NULL) >= MAX_P
    ):
        rows = _knots_apart(values, d, e, tolerance)
        known = (rows * float(np.median(h)) * 1e-9, np.nan) if rows else None
    else:
        knots = np.flatnonzero(e >= BEND_SIZE * tolerance) + 1
        known = _period(place[knots], t[knots], every=False) or (np.nan, np.nan)
    if known is None:
        return None
    share = float(np.mean(e <= tolerance))
    words = f"interpolated or computed in {100.0 * share:.0f} % of rows"
    each = f", straight between values every {known[0]:.4g} s" if np.isfinite(known[0]) else ""
    return RepeatFinding(LINEAR, *known, share, words + each)


def _knots_apart(values: np.ndarray, d: np.ndarray, e: np.ndarray, tolerance: float) -> int:
    """Return every how many rows lines between coarse values have a knot; 0 without such lines.

    There the ranks of `e` are higher on average (the phase of largest z), and the chords of these rows hold the others.
    """
    # As scipy.stats.rankdata, which takes half a second to import.
    _, place, count = np.unique(e[:MAX_RANKED], return_inverse=True, return_counts=True)
    rank = (np.cumsum(count) - 0.5 * (count - 1.0))[place]
    rank = (rank - rank.mean()) / max(float(rank.std()), 1e-9)
    found: list[tuple[float, int, int]] = []
    for rows in range(2, min(MAX_APART, rank.size // MIN_CHANGES) + 1):
        m = rank.size // rows
        z = rank[: m * rows].reshape(m, rows).mean(axis=0) * np.sqrt(m)
        found.append((float(z.max()), rows, int(z.argmax())))
    found = [item for item in sorted(found, reverse=True)[:MAX_CANDIDATES] if item[0] >= MIN_Z]
    if not found or np.unique(values).size <= MAX_LEVELS or _has_pattern(np.diff(d)):
        return 0
    for _, rows, first in found:
        held = []
        # Chords between the middles miss the knots, but for a ramp, of which any chord holds all rows.
        for at in (first, first + rows // 2):
            knots = np.arange(at + 1, values.size, rows)
            within = slice(knots[0], knots[-1] + 1)
            chord = np.interp(np.arange(values.size)[within], knots, values[knots])
            held.append(float(np.mean(np.abs(values[within] - chord) <= tolerance * (1.0 + 1e-6))))
        if held[0] >= MIN_HELD and held[1] < MAX_BETWEEN:
            return rows
    return 0
