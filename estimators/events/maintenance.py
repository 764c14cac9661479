"""Maintenance events, at which a part of the asset is replaced, and the versions of the model between them.

A version of the model lasts from one maintenance to the next; the first is 1. The named states restart from the prior's
variance, uncorrelated with the others, as the earlier estimate belongs to the replaced part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .batch import MAINTENANCE, Events


def maintained(t: int, arrival: int, states: Sequence[int], width: int) -> Events:
    """Return the events of one maintenance at t (ns), one for each state (its index) that restarts."""
    n = len(states)
    return Events(
        np.full(n, t, np.int64),
        np.full(n, arrival, np.int64),
        np.full(n, MAINTENANCE, np.int8),
        np.array(states, np.int32),
        np.full((n, width), np.nan),
    )


def model_versions(events: Events, before: int = 1) -> np.ndarray:
    """Return the version of the model at each event (N,) of an ordered log that begins with version `before`."""
    rows = np.flatnonzero(events.kind == MAINTENANCE)
    first = np.concatenate((rows[:1], rows[1:][np.diff(events.t[rows]) > 0]))
    begins = np.zeros(len(events), np.int64)
    begins[first] = 1
    return before + np.cumsum(begins)


def versions_dropped(events: Events, count: int) -> int:
    """Return how many versions of the model end within the oldest `count` events.

    A maintenance of which some events remain is not counted.
    """
    times = [events.t[part][events.kind[part] == MAINTENANCE] for part in (slice(0, count), slice(count, None))]
    return int(np.setdiff1d(times[0], times[1][:1]).size)


def without(cov: np.ndarray, prior: np.ndarray, state: int) -> np.ndarray:
    """Return a covariance (nx, nx), or variances (1, nx), with one state's variance as in the prior, uncorrelated."""
    if cov.shape[0] == 1 < cov.shape[1]:
        variances = cov.copy()
        variances[0, state] = prior[0, state]
        return variances
    apart = cov.copy()
    apart[state, :] = 0.0
    apart[:, state] = 0.0
    apart[state, state] = prior[0, state] if prior.shape[0] == 1 else prior[state, state]
    return apart
