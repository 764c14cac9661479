"""What was normal when a tuning was accepted: the null against which a change is a change.

Recordings of real assets never leave white innovations. What a tuned filter leaves of data on which it was accepted
is its normal: bias, scale and correlation of each row, and how high each test rises because of what they leave over.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..log import READING
from ..model.state_space import StateSpaceModel
from ..track import FAILED, GATED, USED
from .episodes import Folded, course_of, standardised
from .evidence import BITS, CAUSES, chances_of, highest, no_baseline, threshold_of

MARGIN = 1.5
"""By which a test may rise above the highest that it reached, besides its own threshold: other days are other."""

FEWEST = 50
"""Readings of a row from which on there is a normal."""


class Normal(NamedTuple):
    """What was normal of one sensor row.

    `bias` and `scale` of its standardised innovations e, the lag-1 `correlation` of (e - bias) / scale, and the highest
    W that the tests of each cause `reached`, by its name.
    """

    bias: float
    scale: float
    correlation: float
    reached: Mapping[str, float]


def commission(fold: Folded, evidence: np.ndarray) -> dict[str, Normal]:
    """What is normal in a fold whose tuning is accepted, by sensor row.

    Args:
        fold: Over data on which everything was in order.
        evidence: Its bank's state at the end.

    Returns:
        The normal of each row that has `FEWEST` readings.
    """
    model, log, track = fold.model, fold.log, fold.track
    found: dict[str, Normal] = {}
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero((log.kind[: fold.n] == READING) & (log.channel[: fold.n] == s))
        verdict = track.verdict[rows]
        h = threshold_of(model, evidence, s)
        for k in range(len(sensor.rows)):
            e = standardised(course_of(fold), rows, k)
            known = np.isfinite(e)
            if known.sum() < FEWEST:
                continue
            clipped = np.clip(e[known], -6.0, 6.0)
            bias, scale = float(clipped.mean()), float(max(clipped.std(), 1e-3))
            rest = (clipped - bias) / scale
            phi = float(np.clip(np.mean(rest[1:] * rest[:-1]), -0.95, 0.95))
            index = model.row_start[s] + k
            base = no_baseline(model)[index]
            base[:3] = bias, scale, phi
            base[3:] = np.inf
            judged = np.isin(verdict, (USED, GATED, FAILED))
            refused = np.where(judged, (verdict != USED).astype(np.int8), np.int8(-1))
            values = np.ascontiguousarray(log.value[rows, k])
            W = highest(e, refused, values, float(fold.tuning.r[index]), h, base, chances_of(fold.tuning.gate))
            reached = {}
            for bit, name in enumerate(CAUSES):
                own = W[BITS == 1 << bit]
                if own.size and own.max() > 1.0:
                    reached[name] = round(float(own.max()), 1)
            found[model.row_names[index]] = Normal(round(bias, 3), round(scale, 3), round(phi, 3), reached)
    return found


def baseline_of(model: StateSpaceModel, normals: Mapping[str, Normal]) -> np.ndarray:
    """The bank's baseline, (rows, 3 + TESTS), of what was normal of each row; white innovations for the others."""
    baseline = no_baseline(model)
    for name, normal in normals.items():
        own = baseline[model.row_names.index(name)]
        own[:3] = normal.bias, normal.scale, normal.correlation
        for cause, peak in normal.reached.items():
            own[3:][BITS == 1 << CAUSES.index(cause)] = MARGIN * peak
    return baseline
