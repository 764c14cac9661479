"""Mean and covariance of a weighted cloud, from sums that any number of threads add up alike.

The sums are Σw, Σw², the largest log weight, its member, and from 4 on Σ w d (m,) and Σ w d dᵀ (m, m) of deviations d
from a reference. A block's are added in the order of its members, the blocks' in the order of the blocks. The
last 2 ny are the two tails of the predicted reading, Σ w Φ(z) and Σ w Φ(-z), row by row.
"""

from __future__ import annotations

import numpy as np

from ..numerics.jit import jit
from ..numerics.linalg import wrap
from ..numerics.vectors import dot, exp_minus, total, weighted
from ..numerics.workspace import layout
from .cloud import EQUAL, SETTLED, cloud_of

BLOCK = 1024
"""Members whose sums are added by one thread."""


@layout
def sums_size(nx, ny):
    """Length of the sums of states or readings."""
    k = max(nx, ny)
    return 4 + k + k * k + 2 * ny


@jit
def tails_of(context, sums):
    """The tails of the predicted reading in the sums of a reading: two for each row."""
    return sums[sums.size - 2 * context.width :]


CHUNK = 64
"""Members whose deviations are laid out by row before they are summed: long loops, few of them."""


@jit
def add_chunk(D, n, m, sums):
    """Add n members to the sums: Σw, Σw², and at 4 the m sums Σ w d, then the lower triangle of Σ w d dᵀ.

    D (m + 2, CHUNK) holds the weights in row m and the deviations in the rows above; row m + 1 is scratch.
    """
    w, a = D[m], D[m + 1]
    sums[0] += total(n, w)
    sums[1] += dot(n, w, w)
    for i in range(m):
        sums[4 + i] += weighted(n, w, D[i], a)
        for j in range(i + 1):
            sums[4 + m + i * m + j] += dot(n, a, D[j])


@jit
def add_members(circular, w, records, reference, D, sums):
    """Add particles of weights `w`, and their own covariances if they have any, to the sums of the cloud's moments.

    `circular` (nx,) tells the circular states; D (nx + 2, CHUNK) is scratch.
    """
    nx = reference.size
    own = records.shape[1] > nx
    for first in range(0, w.size, CHUNK):
        n = min(CHUNK, w.size - first)
        for j in range(nx):
            d = D[j]
            middle = reference[j]
            for i in range(n):
                d[i] = records[first + i, j] - middle
            if circular[j] != 0.0:
                for i in range(n):
                    d[i] = wrap(d[i])
        for i in range(n):
            D[nx, i] = w[first + i]
        add_chunk(D, n, nx, sums)
        if own:
            for k in range(n):
                record = records[first + k]
                for i in range(nx):
                    for j in range(i + 1):
                        sums[4 + nx + i * nx + j] += w[first + k] * record[nx + i * nx + j]


@jit
def finish_moments(circular, sums, reference, mean, cov):
    """Mean and covariance from the sums of deviations from a reference."""
    nx = mean.size
    for i in range(nx):
        shift = sums[4 + i] / sums[0]
        for j in range(i + 1):
            value = sums[4 + nx + i * nx + j] / sums[0] - shift * sums[4 + j] / sums[0]
            if i == j:
                value = max(value, 0.0)
            cov[i, j] = value
            cov[j, i] = value
    for i in range(nx):
        mean[i] = reference[i] + sums[4 + i] / sums[0]
        if circular[i] != 0.0:
            mean[i] = wrap(mean[i])


@jit
def cloud_moments(state, nx, n, mean, cov):
    """Weighted mean and covariance of the cloud, about its heaviest particle, so that angles do not tear.

    A circular state's mean is that of the deviations from the heaviest particle, wrapped: the intrinsic mean of any
    cloud that does not reach around the circle.
    """
    cloud = cloud_of(state, nx, n)
    if state[SETTLED] != 0.0:
        mean[:] = cloud.mean
        cov[:] = cloud.cov
        return
    log_w, records = cloud.log_w, cloud.records
    equal = state[EQUAL] != 0.0
    heaviest = 0
    if not equal:
        for i in range(n):
            if log_w[i] > log_w[heaviest]:
                heaviest = i
    sums = np.zeros(4 + nx + nx * nx)
    D = np.empty((nx + 2, CHUNK))
    w = np.empty(BLOCK)
    reference = records[heaviest, :nx].copy()
    top = log_w[heaviest]
    for first in range(0, n, BLOCK):
        last = min(n, first + BLOCK)
        if equal:
            w[:] = 1.0
        else:
            exp_minus(last - first, log_w[first:], top, w)
        add_members(cloud.circular, w[: last - first], records[first:last], reference, D, sums)
    finish_moments(cloud.circular, sums, reference, mean, cov)
