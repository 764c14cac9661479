"""What is believed now of two states, for a chart of one over the other."""

from __future__ import annotations

from typing import Any

import numpy as np

from estimators.errors import ConfigError, nearest

from ..live.interface import Running

MOST = 400
"""Particles that are drawn; of more, each so many-th."""


def pair_from_json(names: Any, engine: Running) -> tuple[int, int] | None:
    """Indices of two states, by their names; None of nothing.

    Raises:
        ConfigError: If they are not two names of states.
    """
    if names is None:
        return None
    known = list(engine.model.state_names)
    if not isinstance(names, list) or len(names) != 2 or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"pair is {names!r}; it must be the names of two states, or null")
    for name in names:
        if name not in known:
            raise ConfigError(f"pair: state {name!r} does not exist; {nearest(name, known)}")
    return known.index(names[0]), known.index(names[1])


def belief_json(engine: Running, i: int, j: int) -> dict[str, Any] | None:
    """Mean (2), covariance [a, b, c] of [[a, b], [b, c]], and points (k, 2); None while it is not a number."""
    belief = engine.belief()
    pair = [i, j]
    mean, cov = belief.mean[pair], belief.cov[np.ix_(pair, pair)]
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        return None
    points = np.asarray(belief.points)[:, pair] if len(belief.points) else np.zeros((0, 2))
    points = points[:: max(1, -(-len(points) // MOST))]
    return {
        "mean": mean.tolist(),
        "cov": [float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])],
        "points": points[np.isfinite(points).all(axis=1)].tolist(),
    }
