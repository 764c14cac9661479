"""Pictures of a large field during a fold: its mean, standard deviation, and true values.

A track keeps a few cells at every event; a picture has all cells at a few times: at the end of each period of the log's
time, and whenever most of the true values are known, at which the estimate is scored over all cells. Both depend on the
log alone, so a refold takes the same pictures.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..log import MARK, TRUTH, Log
from ..model.parts import Field
from ..numerics.quantiles import normal_quantile

MAX_SIDE = 200  # Cells of a picture along an axis at most; a larger field is averaged over squares

MAX_PICTURE_BYTES = 64 * 2**20
"""Bytes that the pictures of a fold may take; then every second of the older ones keeps its numbers only."""


class Picture(NamedTuple):
    """A field before event `before` of the log, at the time `t` of the event before that.

    cells: number of true values, 0 unless most are known; rmse: of their errors; inside: share inside the 95 % band
    (NaN without truth). spread: root mean variance, over the same cells, or all. mean, std, truth (rows, columns):
    float32, NaN where unknown; None if not kept.
    """

    before: int
    t: int
    cells: int
    rmse: float
    inside: float
    spread: float
    mean: np.ndarray | None
    std: np.ndarray | None
    truth: np.ndarray | None


class Pictures:
    """The pictures of one fold, in the order of events."""

    def __init__(self, field: Field, period: float | None) -> None:
        """Create an empty collection.

        Args:
            field: Field of the pictures.
            period: Seconds between two; None for pictures at times with most of the truth only.
        """
        self.field = field
        self.period = None if period is None else max(1, round(period * 1e9))
        self.taken: list[Picture] = []
        rows, columns = plane_shape(field.shape)
        self._most = max(2, MAX_PICTURE_BYTES // (12 * rows * columns))
        self._half = normal_quantile(0.975)

    def due(self, log: Log, n: int) -> bool:
        """Return whether a picture is due before event `n`: a time ends there, with a period or most of the truth."""
        if not 0 < n < log.n or log.t[n] == log.t[n - 1]:
            return False
        if self.period is not None and log.t[n] // self.period != log.t[n - 1] // self.period:
            return True
        last = n - 1
        while last > 0 and log.kind[last] == MARK:  # marks of faults follow true values
            last -= 1
        return bool(log.kind[last] == TRUTH) and self._most_of(self._truth(log, n))

    def next(self, log: Log, n: int, end: int) -> int:
        """Return the first event after `n` before which a picture is due; `end` if there is none."""
        t, kind = log.t[n:end], log.kind[n:end]
        new = t[1:] != t[:-1]
        likely = new & ((kind[:-1] == TRUTH) | (kind[:-1] == MARK))
        if self.period is not None:
            likely |= new & (t[1:] // self.period != t[:-1] // self.period)
        for k in np.flatnonzero(likely):
            if self.due(log, n + int(k) + 1):
                return n + int(k) + 1
        return end

    def check(self, log: Log, n: int) -> bool:
        """Return whether to take a picture now, before event `n`; drop one that is no longer due."""
        there = bool(self.taken) and self.taken[-1].before == log.first + n
        wanted = self.due(log, n)
        if there and not wanted:
            self.taken.pop()
        return wanted and not there

    def take(self, log: Log, n: int, mean: np.ndarray, variances: np.ndarray) -> None:
        """Take a picture before event `n`.

        Args:
            log: The log.
            n: Number of folded events.
            mean: Mean of every cell (nx,).
            variances: Variance of every cell (nx,).
        """
        truth = self._truth(log, n)
        known = np.isfinite(truth)
        cells = int(known.sum()) if self._most_of(truth) else 0
        rmse, inside, spread = np.nan, np.nan, float(np.sqrt(variances.mean()))
        if cells:
            error, variance = (mean - truth)[known], variances[known]
            rmse, spread = float(np.sqrt(np.mean(error**2))), float(np.sqrt(variance.mean()))
            inside = float(np.mean(np.abs(error) <= self._half * np.sqrt(variance)))
        shape = self.field.shape
        self.taken.append(
            Picture(
                log.first + n,
                int(log.t[n - 1]),
                cells,
                rmse,
                inside,
                spread,
                plane(mean, shape),
                np.sqrt(plane(variances, shape)),
                plane(truth, shape) if cells else None,
            )
        )
        kept = [k for k, picture in enumerate(self.taken) if picture.mean is not None]
        if len(kept) > self._most:
            for k in kept[1 : len(kept) // 2 : 2]:
                self.taken[k] = self.taken[k]._replace(mean=None, std=None, truth=None)

    def cut(self, index: int) -> None:
        """Drop the pictures after the absolute index `index`, whose events will be folded again."""
        while self.taken and self.taken[-1].before > index:
            self.taken.pop()

    def drop_front(self, first: int) -> None:
        """Drop the pictures before the absolute index `first`."""
        self.taken = [picture for picture in self.taken if picture.before >= first]

    def _most_of(self, truth: np.ndarray) -> bool:
        return 2 * int(np.isfinite(truth).sum()) > truth.size

    def _truth(self, log: Log, n: int) -> np.ndarray:
        """Return the true values at the time of event n - 1, (nx,), NaN where unknown."""
        truth = np.full(len(self.field), np.nan)
        at = log.t[n - 1]
        for k in range(int(np.searchsorted(log.t[:n], at)), n):
            if log.kind[k] == TRUTH:
                first = int(log.channel[k])
                values = log.value[k, : truth.size - first]
                part = truth[first : first + values.size]
                part[np.isfinite(values)] = values[np.isfinite(values)]
        return truth


def layer(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return rows and columns of the drawn part of a field: a strip of one axis, the middle slice of more than two."""
    return (1, shape[0]) if len(shape) == 1 else (shape[-2], shape[-1])


def reduction(shape: tuple[int, ...]) -> int:
    """Return the number of cells along each side of the squares over which a picture averages."""
    return max(1, -(-max(layer(shape)) // MAX_SIDE))


def plane_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return rows and columns of a picture."""
    side = reduction(shape)
    rows, columns = layer(shape)
    return -(-rows // side), -(-columns // side)


def plane(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return values (nx,) as a picture (rows, columns), float32; a square with an unknown cell is NaN."""
    middle = values.reshape(-1, *layer(shape))
    image = middle[middle.shape[0] // 2]
    side = reduction(shape)
    if side > 1:
        starts = [np.arange(0, n, side) for n in image.shape]
        counts = [np.diff(np.append(start, n)) for start, n in zip(starts, image.shape, strict=True)]
        sums = np.add.reduceat(np.add.reduceat(image, starts[0], axis=0), starts[1], axis=1)
        image = sums / np.outer(*counts)
    return image.astype(np.float32)
