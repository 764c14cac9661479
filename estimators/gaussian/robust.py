"""Protection of Gaussian filters against a wrong model or wrong measurements: inflation, robust weights, adaptation.

A weight enters the update only: gate, NIS and log-likelihood are those of Gaussian noise R, which a fit maximises too.
All are off by default, and then cost a comparison. The memory of an adaptation is part of the filter's state, so it is
rewound and reproduced with it.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import add_process_noise, estimated, options, sensor_rows, sensor_variances
from ..estimator import Option, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import embedded, floats, inlined, part
from ..numerics.linalg import cholesky, solve_transposed, solve_upper

JOSEPH, INFLATION, ROBUST, ROBUST_AT, ADAPT, ADAPT_RATE, ADAPT_BOUND, OWN = range(8)
"""Positions in the context's options; those of the filter itself begin at OWN."""

NONE, HUBER, STUDENT_T = range(3)
"""Weighting of a measurement."""

OFF, ADAPT_R, ADAPT_Q = range(3)
"""Adapted noise."""

JOSEPH_OPTION = Option.choice("joseph", ("off", "on"), "update P by the Joseph form; off subtracts K S Kᵀ, faster", 1)

INFLATION_OPTION = Option("inflation", 1.0, 1.0, 1e9, "1/s", "factor by which P grows in a second, beside Q; 1: none")

OPTIONS = (
    INFLATION_OPTION,
    Option.choice("robust", ("none", "huber", "student-t"), "how the weight of a measurement falls with its distance"),
    Option("huber", 1.345, 0.1, 10.0, "std", "distance from which Huber's weight falls"),
    Option("dof", 4.0, 1.0, 1e4, "", "degrees of freedom of Student's t; fewer have heavier tails"),
    Option.choice("adapt", ("off", "R", "Q"), "noise that is adapted: each sensor row's variance, or all of Q"),
    Option("memory", 200.0, 10.0, 1e5, "readings", "number of measurements over which an adaptation averages"),
    Option("bound", 10.0, 1.0, 1e4, "", "an adapted variance stays within this factor of the tuned one"),
)
"""Options of every Gaussian filter that has a gain of its own."""

MAX_WEIGHT_ITERATIONS = 1000
"""Huber's weight takes a few iterations, Student's t some tens, or hundreds if two weights nearly fit."""


def shared_options(values: Options) -> list[float]:
    """Return the numbers of the shared options, in the order of the positions above."""
    kind = values.get("robust", NONE)
    return [
        values.get("joseph", 0.0),
        float(np.log(values["inflation"])),
        kind,
        values["dof"] if kind == STUDENT_T else values.get("huber", 0.0),
        values.get("adapt", OFF),
        1.0 / values.get("memory", 1.0),
        values.get("bound", 1.0),
    ]


def memory(values: Options, model: StateSpaceModel) -> int:
    """Return the size of an adaptation's memory: two numbers per sensor row for R, one scale for Q."""
    rows = sum(len(sensor.rows) for sensor in model.sensors)
    return {OFF: 0, ADAPT_R: 2 * rows, ADAPT_Q: 1}[int(values["adapt"])]


@inlined
def is_robust(context):
    """Return whether measurements are weighted."""
    return options(context)[ROBUST] != NONE


@inlined
def is_adaptive(context):
    """Return whether R or Q is adapted."""
    return options(context)[ADAPT] != OFF


@inlined
def adapted_variances(context, state):
    """Return the memory of an adapted R: the mean of each sensor row's samples, and its variance, (rows,) each."""
    rows = context.n_rows
    return state[state.size - 2 * rows : state.size - rows], state[state.size - rows :]


@part
def forget(context, state):
    """Reset the memory of an adaptation to the tuned values."""
    kind = options(context)[ADAPT]
    if kind == ADAPT_R:
        mean, used = adapted_variances(context, state)
        r = floats(context.r, context.n_rows)
        for i in range(r.size):
            mean[i] = r[i]
            used[i] = r[i]
    elif kind == ADAPT_Q:
        state[state.size - 1] = 1.0


@part
def growth(context, dt):
    """Return the factor by which P grows in dt seconds, beside Q.

    Old measurements are forgotten exponentially, which keeps the gain from vanishing. As it is a rate, the result does
    not depend on the number of steps. Source: Simon (2006), Optimal State Estimation, 7.4 (the fading-memory filter).
    """
    rate = options(context)[INFLATION]
    return np.exp(rate * dt) if rate != 0.0 else 1.0


@part
def noise_scale(context, state):
    """Return the adapted factor of Q, or 1."""
    return state[state.size - 1] if options(context)[ADAPT] == ADAPT_Q else 1.0


@embedded
def add_noise(context, x, u, dt, state, P, scratch):
    """P ← growth·P + scale·Q, where the covariance of considered states does not grow; scratch is (nx, nx)."""
    scaled = options(context)[INFLATION] != 0.0 or options(context)[ADAPT] == ADAPT_Q
    scale = noise_scale(context, state) if scaled else 1.0
    if scaled:
        multiply(growth(context, dt) / scale, estimated(context), P)
    # Called in one place: it is inlined there.
    add_process_noise(context, x, u, dt, P, scratch)
    if scaled:
        multiply(scale, estimated(context), P)


@part
def multiply(a, estimated, P):
    """P ← D P D, where D has √a on its diagonal for the `estimated` states, and 1 for the considered ones."""
    root = np.sqrt(a)
    for i in range(P.shape[0]):
        for j in range(P.shape[1]):
            if i < estimated and j < estimated:
                P[i, j] *= a
            elif i < estimated or j < estimated:
                P[i, j] *= root


@embedded
def reading_variances(context, sensor, state, r):
    """Fill r (ny,) with the variances, adapted or tuned, of one sensor's rows."""
    first, count = sensor_rows(context, sensor)
    if options(context)[ADAPT] == ADAPT_R:
        _, used = adapted_variances(context, state)
        for i in range(count):
            r[i] = used[first + i]
    else:
        tuned = floats(context.r, context.n_rows)
        for i in range(count):
            r[i] = tuned[first + i]


@part
def weight(kind, at, m, nu, r, S, V, z):
    """Return the weight w of a measurement, whose noise becomes N(0, R / w); NaN if S + R (1/w - 1) has no factor.

    nu, r (m,): innovation and variances of independent rows (a full R is factored before and scaled as a whole, see
    compiled/noise.py); S (m, m) includes R; V (m, m) and z (2 m,) are scratch.
    """
    return huber(at, m, nu, r, S, V, z) if kind == HUBER else student_t(at, m, nu, r, S, V, z)


@part
def huber(k, m, nu, r, S, V, z):
    """Huber's weight w = min(1, k / d), where d is the distance |R^-½ (y - h(x⁺))| that the weighted update leaves.

    It minimises ½ |x - x̂|²_P⁻¹ + ρ_k(d), with ρ_k quadratic up to k and linear beyond. As d = s φ(s) with s = 1 / w
    and φ = |R^½ (S + (s - 1) R)⁻¹ ν|, that is φ(s) = k: Newton's method on 1/φ, which is nearly straight.

    Sources: Huber (1964), doi:10.1214/aoms/1177703732; Moré & Sorensen (1983), doi:10.1137/0904038, for the equation.
    """
    s = 1.0
    for _ in range(MAX_WEIGHT_ITERATIONS):
        if not precision_times(s, m, nu, r, S, V, z):
            return np.nan
        square = 0.0
        for i in range(m):
            square += r[i] * z[i] * z[i]
            z[i] *= r[i]
        excess = np.sqrt(square) / k - 1.0
        if excess <= 1e-12:
            break
        solve_transposed(V, m, z)
        slope = 0.0
        for i in range(m):
            slope += z[i] * z[i]
        s += excess * square / slope
    return 1.0 / s


@part
def student_t(dof, m, nu, r, S, V, z):
    """The mean precision, as a share of R⁻¹, of noise that follows a multivariate t with scale matrix R.

    w = (dof + m) / (dof + tr(R⁻¹ E (y - h(x)) (y - h(x))ᵀ)), the variational solution, iterated from w = 1. With
    T = S + (1/w - 1) R the residual is R/w T⁻¹ ν, and H P⁺ Hᵀ = R/w - R/w T⁻¹ R/w.

    Source: Piché, Särkkä & Hartikainen (2012), doi:10.1109/MLSP.2012.6349794.
    """
    w = 1.0
    unit = z[m : 2 * m]
    for _ in range(MAX_WEIGHT_ITERATIONS):
        if not precision_times(1.0 / w, m, nu, r, S, V, z):
            return np.nan
        total = 0.0
        for i in range(m):
            for j in range(m):
                unit[j] = 1.0 if j == i else 0.0
            solve_transposed(V, m, unit)
            inverse = 0.0
            for j in range(m):
                inverse += unit[j] * unit[j]
            total += 1.0 / w + r[i] * (z[i] * z[i] - inverse) / (w * w)
        better = (dof + m) / (dof + total)
        if abs(better - w) <= 1e-12 * w:
            return better
        w = better
    return w


@part
def precision_times(s, m, nu, r, S, V, z):
    """Fill z with T⁻¹ ν and V with the factor of T = S + (s - 1) R; False if T has none."""
    for i in range(m):
        for j in range(m):
            V[i, j] = S[i, j]
        V[i, i] += (s - 1.0) * r[i]
        z[i] = nu[i]
    if not cholesky(V, V, m):
        return False
    solve_transposed(V, m, z)
    solve_upper(V, m, z)
    return True


@part
def reweigh(context, m, nu, raw, d, S, U, V, z):
    """Weight the noise of a measurement: d is divided by w; S, its factor U and the whitened nu follow.

    Args:
        context: The context.
        m: Number of finite rows.
        nu: Gets the whitened innovation (m,).
        raw: The innovation (m,), its rows' noise independent.
        d: Variances of that noise (m,).
        S: Covariance of the innovation (m, m), which includes d.
        U: Gets the factor of S.
        V: Scratch (m, m).
        z: Scratch (2 m,).

    Returns:
        The weight w; NaN if S has no factor with it.
    """
    w = weight(options(context)[ROBUST], options(context)[ROBUST_AT], m, raw, d, S, V, z)
    for i in range(m):
        S[i, i] += (1.0 / w - 1.0) * d[i]
        nu[i] = raw[i]
        d[i] /= w
    if not cholesky(S, U, m):
        return np.nan
    solve_transposed(U, m, nu)
    return w


@part
def adapt(context, sensor, y, state, innovation, innovation_std, score):
    """Adapt R or Q to the innovations of used measurements, with a fading memory of N measurements.

    R: r ← mean of ν² - (S - r), of each row. Q: one factor s of all of Q, s ← s (1 + (NIS / m - 1) / N), so that the
    mean NIS becomes what it should be. Only one of the two can be adapted, as both act on the size of ν alone. The
    values in use stay within the bound. The spread of an adapted r is about S √(2 / (2N - 1)), that of ln s about
    1 / √(N m γ) with γ the share of S that scales with s.

    Correlated rows keep their correlation. An outlier counts fully: use the gate; softened
    measurements do not count. Sources: Mohamed & Schwarz (1999),
    doi:10.1007/s001900050236, for R (there over a window); Bar-Shalom, Li & Kirubarajan (2001), 11.2, for the level of
    Q.
    """
    kind = options(context)[ADAPT]
    rate = options(context)[ADAPT_RATE]
    bound = options(context)[ADAPT_BOUND]
    if kind == ADAPT_Q:
        scale = noise_scale(context, state) * (1.0 + rate * (score[0] / score[1] - 1.0))
        state[state.size - 1] = min(max(scale, 1.0 / bound), bound)
        return
    first, count = sensor_rows(context, sensor)
    tuned = sensor_variances(context, sensor)
    mean, used = adapted_variances(context, state)
    for i in range(count):
        if np.isfinite(y[i]):
            row = first + i
            sample = innovation[i] ** 2 - innovation_std[i] ** 2 + used[row]
            mean[row] += rate * (sample - mean[row])
            used[row] = min(max(mean[row], tuned[i] / bound), tuned[i] * bound)
