"""From how many particles the present ones descend: what resampling has left of a cloud.

Every `LAG` readings each particle is given its own number, which its children inherit. How many numbers are left after
`LAG` more says how many particles of then have descendants now. Where it is one, whatever does not move by itself (a
parameter, a slow state) has a single value in all of the cloud, and its spread is nothing but noise since.

Source: Jacob, Murray & Rubenthaler (2015), Path storage in the particle filter, doi:10.1007/s11222-013-9445-x, for how
the ancestors of a cloud die out.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..estimator import Options
from ..numerics.jit import jit, matrix
from ..track import ANCESTORS, EFFECTIVE
from .cloud import ESS, GENERATIONS, MEMBERS, ORIGINS, RECOVERIES, RESAMPLED, cloud_of, members
from .resampling import take_ancestors

LAG = 20
"""Readings that are used between two counts."""


@jit
def begin_lineage(context, state):
    """Every particle is its own origin."""
    n = int(numbers(context)[MEMBERS])
    _number(cloud_of(state, context.nx, n).lineage)
    state[ORIGINS] = n
    state[GENERATIONS] = 0.0


@jit
def _number(lineage):
    for i in range(lineage.size):
        lineage[i] = i


@jit
def inherit(context, ancestors, state):
    """Children take the origin of their ancestors (N,)."""
    n = int(numbers(context)[MEMBERS])
    take_ancestors(ancestors, matrix(cloud_of(state, context.nx, n).lineage, 0, n, 1))


@jit
def count_origins(context, state):
    """Another reading is used: every `LAG` of them, count the origins and begin anew."""
    state[GENERATIONS] += 1.0
    if state[GENERATIONS] < LAG:
        return
    lineage = cloud_of(state, context.nx, int(numbers(context)[MEMBERS])).lineage
    # Families lie side by side in the order of their ancestors, so an origin is where the number changes.
    origins = 1
    for i in range(1, lineage.size):
        if lineage[i] != lineage[i - 1]:
            origins += 1
    _number(lineage)
    state[ORIGINS] = origins
    state[GENERATIONS] = 0.0


@jit
def score_cloud(state, score):
    """What the track keeps of a cloud after a reading that was used."""
    score[EFFECTIVE] = state[ESS]
    score[ANCESTORS] = state[ORIGINS]


def account(options: Options, state: np.ndarray, nx: int) -> dict[str, float | list[float]]:
    """How many particles there are, how many count, from how many of `lag` readings ago they descend, and repairs."""
    return {
        "particles": float(members(options)),
        "effective": float(state[ESS]),
        "ancestors": float(state[ORIGINS]),
        "lag": float(LAG),
        "resampled": float(state[RESAMPLED]),
        "recovered": float(state[RECOVERIES]),
    }
