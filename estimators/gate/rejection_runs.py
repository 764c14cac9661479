"""Count consecutive rejections of each sensor: more than chance allows mean that the sensor or the twin is wrong.

A run begins after the last measurement on which sensor and twin agreed. Its state evolves with the events, like that of
a filter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from ..numerics.jit import i64, inlined

RUN_PROBABILITY = 1e-9
"""Probability of a run of rejected good measurements that is long enough for a decision."""

MIN_RUN = 3
"""Least length of such a run: outliers come in pairs more often than by chance."""

SETTLED_MEASUREMENTS = 10
"""Consecutive accepted measurements after which a doubted sensor agrees again."""

RUN, SINCE, FROM, PASSED, DUE, WAIT, ASKED, EVER = range(8)
"""Columns of the state of a sensor: consecutive rejections; absolute index and time (ns) of the first; consecutive
accepted measurements; time from which the next decision is due, and seconds waited after the last; 1 after a decision;
1 after a measurement was accepted."""

REMEMBERED = 8


class Rule(NamedTuple):
    """The gate in a fold: whether it is soft, and the run of rejections that needs a decision (0: never)."""

    soft: int
    most: int


rule_type = types.NamedUniTuple(i64, len(Rule._fields), Rule)


def rule_of(gate: float | None, kind: str, reopens: bool) -> Rule:
    """Return the rule of a gate that a good measurement passes with probability `gate`."""
    if gate is None:
        return Rule(0, 0)
    most = max(MIN_RUN, math.ceil(math.log(RUN_PROBABILITY) / math.log(max(1.0 - gate, RUN_PROBABILITY))))
    return Rule(int(kind == "soft"), most if reopens else 0)


def fresh(sensors: int) -> np.ndarray:
    """Return the state before the first event, (sensors, REMEMBERED)."""
    doubt = np.zeros((sensors, REMEMBERED))
    doubt[:, DUE] = -np.inf
    return doubt


@inlined
def forget(doubt):
    """Clear the state at a reset."""
    doubt[:] = 0.0
    doubt[:, DUE] = -np.inf


@inlined
def note(own, most, refused, index, now):
    """Note a measurement that was rejected or accepted; return whether a decision is due.

    Args:
        own: State of the sensor, (REMEMBERED,).
        most: Rejections in a row that need a decision, 0 for never.
        refused: Whether the measurement lay beyond the gate.
        index: Its absolute index.
        now: Its time, ns.
    """
    if refused:
        if own[RUN] == 0.0:
            own[SINCE] = index
            own[FROM] = now
        own[RUN] += 1.0
        own[PASSED] = 0.0
        return most > 0 and own[RUN] >= most and now >= own[DUE]
    own[RUN] = 0.0
    own[PASSED] += 1.0
    own[EVER] = 1.0
    return own[PASSED] == SETTLED_MEASUREMENTS and own[ASKED] != 0.0
