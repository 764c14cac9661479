"""Where readings lie among what the members expect: a histogram that is flat where truth and members are drawn alike.

A U shape says that the spread is too small, a hump that it is too large, a slope that the model is biased.

Sources: Hamill (2001), doi:10.1175/1520-0493(2001)129<0550:IORHFV>2.0.CO;2; the sensor's noise on each member's
expectation as in section 3 there.
"""

from __future__ import annotations

import numpy as np

from ..estimator import Options
from ..numerics.jit import jit
from ..numerics.random import key_of, normal, unit, word
from .shared import BINS, RANK, members, members_at, parts, view


@jit
def count_ranks(context, m, ZT, d, rows, state):
    """Count in which tenth of the members' expectations, each with noise of its own, every row of a reading lies.

    Args:
        context: The context.
        m: Finite rows.
        ZT: (m, N): (h(xᵢ) - ȳ) / √(r (N - 1)).
        d: (m,): (y - ȳ) / √r.
        rows: (m,): which row of the reading each is.
        state: The filter's state; gets the counts, and no other change.
    """
    N = ZT.shape[1]
    own = parts(context, state)
    key = key_of(context.seed, int(own.draws[0]), RANK)
    scale = np.sqrt(N - 1.0)
    for k in range(m):
        place = rows[k] * (N + 1)
        rank = unit(word(key, np.uint64(place + N)))
        for i in range(N):
            if scale * ZT[k, i] + normal(key, np.uint64(place + i)) < d[k]:
                rank += 1.0
        own.ranks[min(int(BINS * rank / (N + 1.0)), BINS - 1)] += 1.0


def account(options: Options, state: np.ndarray, nx: int) -> dict[str, float | list[float]]:
    """How many members there are, and the rank histogram since the filter started, in `BINS` bins."""
    ranks = view(members_at(0, members(options), nx).ranks, state)
    return {"members": float(members(options)), "ranks": [float(count) for count in ranks]}
