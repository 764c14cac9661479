"""What a refused reading costs: the log of the density that the filter, its gate included, gave to it.

A gate that a good reading passes with probability P says of a reading more than N(ŷ, S): inside the gate it is as
predicted, and with 1 - P it is outside, where nothing is known but that it is an outlier. As a density,

    p(y) = N(y; ŷ, S)                                    where NIS ≤ g, the gate's quantile: together P
    p(y) = (1 - P) t(y; ŷ, S) / Pr_t(NIS > g)             beyond: together 1 - P

with t the Cauchy density in the reading's m rows, the Student t of one degree of freedom: an outlier's distance has no
scale, and its cost grows with the distance's logarithm only. So p integrates to one, and the sum of log p over a log is
a proper score: by Gibbs' inequality no filter's is expected to exceed that of the density from which the readings come.
Two things follow. A filter that refuses everything stays at least log(1 / (1 - P)) a reading below a consistent one
that knows as much. And a consistent filter loses next to nothing: 1 - P of its readings cost a few units more than
N(ŷ, S) would say. A density fitted to what was refused (as wide as the filter is wrong) would give neither, and a
uniform one needs a range that sensors do not have.

|S| is replaced by the product of its diagonal, which the track keeps for every filter. That is never less (Hadamard),
so p integrates to one at most, and to one exactly for a reading of one row. A particle filter's gate is by its moments,
so its mixture may have more inside than P, by 1 - P at most: more than that a reading its score cannot gain.

Sources: Gneiting & Raftery (2007), doi:10.1198/016214506000001437, for proper scores; Kotz & Nadarajah, Multivariate t
Distributions and Their Applications (2004), 1.1 and 1.10, for t and its NIS / m, which is F(m, 1).
"""

from __future__ import annotations

import numpy as np
from scipy.special import betainc, gammaln

from ..numerics.quantiles import chi_square_quantile
from ..track import Track


def log_density(refused: Track, gate: float | None) -> np.ndarray:
    """Log of p at refused readings, (N,), in the units of the rows; -inf where a NIS is not finite, NaN without a gate.

    Args:
        refused: Rows of a track whose verdict is that the gate refused the reading.
        gate: P, as the tuning has it.
    """
    if gate is None:
        return np.full(len(refused), np.nan)
    m = np.asarray(refused.dof, float)
    # Of t: log Γ((m + 1) / 2) - ½ log π - ½ m log π - ½ log |S| - ½ (m + 1) log(1 + NIS)
    constant = gammaln(0.5 * (m + 1.0)) - 0.5 * (m + 1.0) * np.log(np.pi)
    with np.errstate(all="ignore"):
        log_scale = np.nansum(np.log(refused.innovation_std), axis=1)
        cauchy = constant - log_scale - 0.5 * (m + 1.0) * np.log1p(refused.nis)
    # F(m, 1) exceeds g / m with the probability I(1 / (1 + g); ½, m / 2).
    beyond = betainc(0.5, 0.5 * m, 1.0 / (1.0 + chi_square_quantile(gate, m)))
    found = np.log1p(-gate) + cauchy - np.log(beyond)
    return np.where(np.isfinite(found), found, -np.inf)
