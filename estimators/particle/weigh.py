"""Particles are weighed by a reading: p(y | x), Gaussian over the rows that are there, or the sensor's own."""

from __future__ import annotations

import numpy as np

from ..compiled.context import (
    circular_rows,
    expect,
    expect_points,
    has_own_likelihood,
    own_likelihood,
    sensor_variances,
)
from ..compiled.context import options as numbers
from ..compiled.noise import has_correlated_rows, independent_rows
from ..compiled.verdict import LOG_2PI
from ..numerics.jit import jit
from ..numerics.linalg import solve_unit, wrap
from ..numerics.normal_score import add_tails
from ..numerics.vectors import exp_minus
from .cloud import EQUAL, MEMBERS, cloud_of
from .innovation import about, first_residual
from .moments import CHUNK, add_chunk, tails_of
from .propagate import room_of
from .steps import block_of, range_of, work_of


@jit
def weigh_block(context, u, dt, sensor, y, key, value, state, work, number):
    """joint = log w + log p(y | x), and the sums of the residuals' mean and covariance under the predicted weights.

    And of the two tails of each row, see `score_rows`. A density that is NaN counts as zero. The sums are about
    `first_residual`.
    """
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, context.nx, n)
    room, block = room_of(context, shared, number), block_of(context, shared, number)
    joint, log_w, records = shared.joint, cloud.log_w, cloud.records
    expected, D, sums = room.expected, block.D, block.sums
    equal = state[EQUAL] != 0.0
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    own = has_own_likelihood(context, sensor)
    correlated = has_correlated_rows(context, sensor)
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    tails = tails_of(context, sums)
    ny = r.size
    reference = np.empty(ny)
    first_residual(context, u, sensor, y, records[0], reference)
    m = independent_rows(context, sensor, y, r, room.F, room.d)
    constant = 0.0
    for k in range(m):
        constant -= 0.5 * (LOG_2PI + np.log(room.d[k]))
    top = -np.inf
    first, last = range_of(number, n)
    for begin in range(first, last, CHUNK):
        count = min(CHUNK, last - begin)
        expect_points(context, sensor, records[begin : begin + count], u, expected)
        for row in range(ny):
            for i in range(count):
                D[row, i] = y[row] - expected[i, row]
        for i in range(count):
            joint[begin + i] = constant
        k = 0
        for row in range(ny):
            if not np.isfinite(y[row]):
                continue
            # Row `row` moves up to k ≤ row.
            d = D[k]
            weight = 0.0 if correlated else 0.5 / r[row]
            for i in range(count):
                e = D[row, i]
                if circular[row] != 0:
                    e = wrap(e)
                if correlated:
                    expected[i, k] = e
                d[i] = about(e, reference[row], circular[row])
                joint[begin + i] -= weight * e * e
            k += 1
        if correlated:
            for i in range(count):
                joint[begin + i] -= half_square(room.F, room.d, m, expected[i])
        if own:
            for i in range(count):
                joint[begin + i] = own_likelihood(context, sensor, y, records[begin + i, : context.nx], u)
        # Row m + 1 is free for the weights until the sums are made.
        if equal:
            for i in range(count):
                D[m + 1, i] = 1.0
        else:
            exp_minus(count, log_w[begin:], 0.0, D[m + 1])
        for i in range(count):
            w = D[m + 1, i]
            density = joint[begin + i] + log_w[begin + i]
            # A density that is NaN, or an expectation: the particle is out, and out of the sums.
            if not -np.inf < density < np.inf:
                density = -np.inf
                for k in range(m):
                    if not np.isfinite(D[k, i]):
                        w = 0.0
                        D[k, i] = 0.0
            joint[begin + i] = density
            D[m, i] = w
            if density > top:
                top = density
                sums[3] = begin + i
        if not own:
            k = 0
            for row in range(ny):
                if np.isfinite(y[row]):
                    add_tails(count, D[k], reference[row], 1.0 / np.sqrt(r[row]), D[m], tails[2 * k :])
                    k += 1
        add_chunk(D, count, m, sums)
    sums[2] = top


@jit
def half_square(F, d, m, e):
    """½ eᵀ R⁻¹ e of a residual e (m,) with R = F diag(d) Fᵀ; e becomes F⁻¹ e."""
    solve_unit(F, m, e)
    half = 0.0
    for k in range(m):
        half += 0.5 * e[k] * e[k] / d[k]
    return half


@jit
def log_density(context, sensor, u, y, x, F, d, e):
    """log p(y | x): Gaussian over the rows that are there, or the sensor's own; -inf if it is NaN.

    F and d are those of `independent_rows`, e (ny,) is scratch.
    """
    if has_own_likelihood(context, sensor):
        value = own_likelihood(context, sensor, y, x, u)
    else:
        circular = circular_rows(context, sensor)
        expect(context, sensor, x, u, e)
        m = 0
        for row in range(circular.size):
            if np.isfinite(y[row]):
                # Row `row` moves up to m ≤ row.
                e[m] = y[row] - e[row]
                if circular[row] != 0:
                    e[m] = wrap(e[m])
                m += 1
        if has_correlated_rows(context, sensor):
            solve_unit(F, m, e)
        value = 0.0
        for k in range(m):
            value -= 0.5 * (e[k] * e[k] / d[k] + LOG_2PI + np.log(d[k]))
    return value if -np.inf < value < np.inf else -np.inf
