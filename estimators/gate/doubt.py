"""When a sensor is refused for longer than chance allows, so that it or the twin must be wrong.

Chance refuses `most` good readings in a row once in a thousand million of them. A run of refusals begins after the last
reading with which sensor and twin agreed; what is remembered of it goes on with the events, like a filter's state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from ..numerics.jit import i64, inlined

CHANCE = 1e-9
"""Probability with which as many good readings in a row are refused as raise a doubt."""

FEWEST = 3
"""Refusals in a row that raise one at least: outliers come in pairs more often than chance has it."""

SETTLED = 10
"""Readings in a row that must pass before a sensor that was in doubt agrees again."""

RUN, SINCE, FROM, PASSED, DUE, WAIT, ASKED, EVER = range(8)
"""What is remembered of each sensor: refusals in a row; the absolute index of the first and its time, ns; readings in
a row that passed; time from which on the next decision is due, and seconds waited after the last; 1 once a decision was
taken; 1 once a reading of it has passed."""

REMEMBERED = 8


class Rule(NamedTuple):
    """What the fold's loop knows of the gate: whether it is soft; refusals in a row that raise a doubt, 0 for never."""

    soft: int
    most: int


rule_type = types.NamedUniTuple(i64, len(Rule._fields), Rule)


def rule_of(gate: float | None, kind: str, reopens: bool) -> Rule:
    """The rule of a gate that a good reading passes with probability `gate`."""
    if gate is None:
        return Rule(0, 0)
    most = max(FEWEST, math.ceil(math.log(CHANCE) / math.log(max(1.0 - gate, CHANCE))))
    return Rule(int(kind == "soft"), most if reopens else 0)


def fresh(sensors: int) -> np.ndarray:
    """No doubt of any sensor, (sensors, REMEMBERED)."""
    doubt = np.zeros((sensors, REMEMBERED))
    doubt[:, DUE] = -np.inf
    return doubt


@inlined
def forget(doubt):
    """A reset: no doubt of any sensor."""
    for s in range(doubt.shape[0]):
        for k in range(doubt.shape[1]):
            doubt[s, k] = 0.0
        doubt[s, DUE] = -np.inf


@inlined
def note(own, most, refused, index, now):
    """Note a reading of a sensor that was refused, or that passed; True if a decision is due.

    Args:
        own: What is remembered of the sensor, (REMEMBERED,).
        most: Refusals in a row that raise a doubt, 0 for never.
        refused: Whether the reading lay beyond the gate.
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
    return own[PASSED] == SETTLED and own[ASKED] != 0.0
