"""The order of a log: by time, and at one time the same whatever the order of arrival.

At one time come the inputs first, as a reading is predicted with the inputs that hold when it is taken; then the
readings; then what asks for the estimate without changing it, true states, ticks and marks, which so see all that was
said at their time; and maintenance and a reset last, as whoever resets has seen what came. Events of one kind follow
their channel: sensors in the order of the model. What is left, several events of one kind, channel and time, goes by
its values, the smallest first and a missing one last: of two inputs at one time the larger holds. Order of arrival
could not decide that, as a late event would then count for more than the same event in time.
"""

from __future__ import annotations

import numpy as np

from .batch import INPUT, MAINTENANCE, MARK, READING, RESET, TICK, TRUTH, Events

_ORDER = (INPUT, READING, TRUTH, TICK, MARK, MAINTENANCE, RESET)
_RANK = np.array([_ORDER.index(kind) for kind in range(len(_ORDER))], np.int64) << 32


def in_order(events: Events) -> bool:
    """Whether each event comes after the one before it, with no two that only their values could order."""
    t = events.t
    if t.size < 2:
        return True
    later = t[1:] > t[:-1]
    if later.all():
        return True
    place = _RANK.take(events.kind) + events.channel
    return bool(np.all(later | ((t[1:] == t[:-1]) & (place[1:] > place[:-1]))))


def sorted_order(events: Events) -> np.ndarray:
    """The permutation (N,) that puts events in the order of a log."""
    place = _RANK.take(events.kind) + events.channel
    order: np.ndarray = np.lexsort((place, events.t))
    t, at = events.t[order], place[order]
    if np.any((t[1:] == t[:-1]) & (at[1:] == at[:-1])):
        order = np.lexsort((*events.value.T[::-1], place, events.t))
    return order
