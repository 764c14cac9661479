"""What (I + A)^(-1/2) makes of a vector, for symmetric positive semidefinite A, without eigenvectors: eight at a time.

A = Hᵀ T H with H a product of reflections and T tridiagonal; and the inverse root is a sum of resolvents,

    (I + T)^(-1/2) ≈ Σ_k w_k ((1 + σ_k) I + T)⁻¹,

to the last bit with a dozen or two of them: the trapezoidal rule on an integral that elliptic functions have smoothed.
Each is a tridiagonal system. Turning the vector by the rotations of a QL iteration takes ten times as long.

Every number depends on the matrix of its lane alone (see simd_lanes.py), but for the number of resolvents.

Source: Hale, Higham & Trefethen (2008), Computing A^α, log(A), and related matrix functions by contour integrals,
doi:10.1137/070700607, method 3, with the real form of its elliptic functions; these by Jacobi's theta functions (NIST
Digital Library of Mathematical Functions, 22.2 and 20.2).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import ellipk, ellipkm1

from .jit import jit
from .simd_ir import LANES, integer, steps, vector_code
from .simd_lanes import LaneRows, find_reflection, lane_dot, multiply, reflect, reflect_back, subtract
from .workspace import declare_layout

_GROUP = 4
"""Resolvents that are computed at a time, so that the divisions of one do not wait for those of another."""

_RULES = 35
"""The finest rule has this many groups of resolvents and one more; it is good up to `_UP_TO[-1]`."""

_EPSILON = 2.3e-16


def _rule(count: int, condition: float) -> tuple[np.ndarray, np.ndarray]:
    """Shifts σ and weights w, (count,), with x^(-1/2) ≈ Σ w / (x + σ) for 1 ≤ x ≤ condition.

    σ = (sn / cn)² and w = 2 K' / (π count) dn / cn² at (j + 1/2) K' / count, the modulus being that whose complement is
    k = condition^(-1/2). They are computed at the imaginary argument for the modulus k, whose nome is small, up to the
    middle; behind it, σ ← condition / σ and w ← w √condition / σ.
    """
    K, other = ellipk(1.0 / condition), ellipkm1(1.0 / condition)
    nome = np.exp(-np.pi * other / K)
    angle = np.pi * (np.arange(count // 2) + 0.5) * other / (count * 2.0 * K)
    n = np.arange(8.0)[:, None]
    sign, odd, even = (-1.0) ** n, nome ** (n + 0.5) ** 2, nome**n**2
    theta_1 = np.sum(2.0 * sign * odd * np.sinh((2.0 * n + 1.0) * angle), axis=0)
    theta_2, at_2 = (np.sum(2.0 * odd * np.cosh((2.0 * n + 1.0) * z), axis=0) for z in (angle, 0.0))
    theta_3, at_3 = (np.sum(2.0 * even * np.cosh(2.0 * n * z), axis=0) - 1.0 for z in (angle, 0.0))
    theta_4, at_4 = (np.sum(2.0 * sign * even * np.cosh(2.0 * n * z), axis=0) - 1.0 for z in (angle, 0.0))
    shifts = (at_3 / at_2 * theta_1 / theta_4) ** 2
    weights = 2.0 * other / (np.pi * count) * (at_4 / at_2 * theta_2 / theta_4) * (at_4 / at_3 * theta_3 / theta_4)
    return (
        np.append(shifts, condition / shifts),
        np.append(weights, weights * np.sqrt(condition) / shifts),
    )


def _rules() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For 2, 3, … groups of resolvents: the largest 1 + λ at which they are good to the last bit, shifts, weights."""
    # The rule's error is 4 exp(-2 π² count / log(16 condition)), nearly.
    counts = _GROUP * (np.arange(_RULES) + 2)
    up_to = np.exp(counts / 1.86) / 16.0
    shifts, weights = np.zeros((2, _RULES, counts[-1]))
    for k, (count, condition) in enumerate(zip(counts, up_to, strict=True)):
        shifts[k, :count], weights[k, :count] = _rule(int(count), float(condition))
    return up_to, shifts, weights


_UP_TO, _SHIFTS, _WEIGHTS = _rules()
_SHRINKS = _WEIGHTS / (1.0 + _SHIFTS)
_NO_SHIFT, _ONE = np.zeros(1), np.ones(1)


Action, action_at = declare_layout(
    "Action",
    "n",
    d=f"n, {LANES}",
    e=f"n + 1, {LANES}",
    inverses=f"n, {LANES}",
    w=f"n, {LANES}",
    x=f"n, {LANES}",
    largest=f"{LANES}",
    rest=f"{_GROUP} * (2 * n + 1), {LANES}",
)
"""Scratch of `root_action` at order n or below: T, the reflections, two vectors, and factors of resolvents."""


@vector_code()
def _largest_row(v, n, d, e, largest):
    """The largest sum of absolute values of a row of T (n, n); no eigenvalue is larger (Gershgorin)."""
    builder = v.builder
    d, e, largest = LaneRows(v, d), LaneRows(v, e), LaneRows(v, largest)
    most = v.variable()
    with steps(builder, 0, n) as i:
        beside = builder.fadd(v.unary("fabs", e[i]), v.unary("fabs", e[builder.add(i, integer(1))]))
        total, found = builder.fadd(v.unary("fabs", d[i]), beside), builder.load(most)
        # Unordered, so that a number that is no number stays.
        builder.store(builder.select(builder.fcmp_unordered("<=", total, found), found, total), most)
    largest[integer(0)] = builder.load(most)


@vector_code()
def _shift(v, n, d, by, factor):
    """d[:n] += 1 + factor by[0]."""
    d, by = LaneRows(v, d), LaneRows(v, by)
    added = v.multiply_add(v.spread(factor), by[integer(0)], v.constant(1.0))
    with steps(v.builder, 0, n) as i:
        d[i] = v.builder.fadd(d[i], added)


def _resolving(group: int) -> Callable:
    @vector_code()
    def resolve(v, n, d, e, b, count, shifts, weights, scratch, out):
        """out[:n] = Σ_k weights[k] (T + shifts[k] I)⁻¹ b, T tridiagonal with diagonal d[:n], and e[1:n] beside it.

        By elimination without exchanges, which is stable where all T + shifts[k] I are positive definite; `group`
        shifts at a time, of `count`. e[0] must be 0. `scratch` holds group (2 n + 1) rows.
        """
        builder, zero, one = v.builder, v.constant(0.0), v.constant(1.0)
        own, beside, right, out = (LaneRows(v, array) for array in (d, e, b, out))
        factors = LaneRows(v, scratch)
        values = builder.mul(builder.add(n, integer(1)), integer(group))
        inverses, ys = ([v.variable() for _ in range(group)] for _ in range(2))
        with steps(builder, 0, n) as i:
            out[i] = zero
        for s in range(group):
            factors[builder.add(builder.mul(n, integer(group)), integer(s))] = zero
        with steps(builder, 0, count, group) as first:
            shift, weight = (
                [v.entry(array.data, builder.add(first, integer(s))) for s in range(group)]
                for array in (shifts, weights)
            )
            for one_of in (*inverses, *ys):
                builder.store(zero, one_of)
            with steps(builder, 0, n) as i:
                side, diagonal, target = beside[i], own[i], right[i]
                to = builder.mul(i, integer(group))
                for s in range(group):
                    factor = builder.fmul(side, builder.load(inverses[s]))
                    minus = builder.fneg(factor)
                    pivot = v.multiply_add(minus, side, builder.fadd(diagonal, shift[s]))
                    value = v.multiply_add(minus, builder.load(ys[s]), builder.fmul(weight[s], target))
                    inverted = builder.fdiv(one, pivot)
                    builder.store(inverted, inverses[s])
                    builder.store(value, ys[s])
                    at = builder.add(to, integer(s))
                    factors[at] = factor
                    factors[builder.add(values, at)] = builder.fmul(value, inverted)
            for y in ys:
                builder.store(zero, y)
            with steps(builder, 0, n) as back:
                i = builder.sub(builder.sub(n, integer(1)), back)
                to = builder.mul(i, integer(group))
                total = out[i]
                for s in range(group):
                    at = builder.add(to, integer(s))
                    factor = builder.fneg(factors[builder.add(at, integer(group))])
                    x = v.multiply_add(factor, builder.load(ys[s]), factors[builder.add(values, at)])
                    builder.store(x, ys[s])
                    total = builder.fadd(total, x)
                out[i] = total

    return resolve


_resolve, _resolve_one = _resolving(_GROUP), _resolving(1)


@jit
def root_action(A, n, b, g, inverse_root, room, product):
    """b ← f(A) b for symmetric positive semidefinite A, f(λ) = 1/√(1+λ) or (1 - 1/√(1+λ)) / λ.

    The second is Σ w_k / ((1 + σ_k) (1 + λ + σ_k)), from the first's values at 0 and at λ, without a difference.

    Args:
        A: Symmetric matrices, entry (i, j) in row i n + j, of which j ≥ i is read: (n², LANES). Is destroyed.
        n: Order.
        b: Vectors (n, LANES).
        g: Others, destroyed.
        inverse_root: Whether f is the first, or else the second.
        room: Scratch, `Action` of order n or above.
        product: Gets bᵀ (I + A)⁻¹ g of the b given (LANES,); NaN if a number is not finite.
    """
    d, e, inverses, w, x, largest, rest, _ = room
    e[0], e[n] = 0.0, 0.0
    for k in range(n - 2):
        find_reflection(n, k, A, d, e, inverses)
        multiply(n, k, A, w)
        reflect(n, k, A, inverses, w, b, g)
        subtract(n, k, A, w)
    for lane in range(LANES):
        for k in range(max(n - 2, 0), n):
            d[k, lane] = A[k * n + k, lane]
        if n > 1:
            e[n - 1, lane] = A[(n - 2) * n + n - 1, lane]
    _largest_row(n, d, e, largest)
    most = 0.0
    for lane in range(LANES):
        if largest[lane] < np.inf:
            most = max(most, largest[lane])
    # Rounding left T's eigenvalues off by so much; none may come out below 0.
    _shift(n, d, largest, 4.0 * _EPSILON)
    rule = 0
    while rule < _RULES - 1 and _UP_TO[rule] < 1.0 + most:
        rule += 1
    _resolve_one(n, d, e, g, 1, _NO_SHIFT, _ONE, rest, x)
    lane_dot(n, b, x, product)
    for lane in range(LANES):
        if not largest[lane] < np.inf:
            product[lane] = np.nan
    weights = _WEIGHTS[rule] if inverse_root else _SHRINKS[rule]
    _resolve(n, d, e, b, _GROUP * (rule + 2), _SHIFTS[rule], weights, rest, x)
    for k in range(n):
        for lane in range(LANES):
            b[k, lane] = x[k, lane]
    for k in range(n - 3, -1, -1):
        reflect_back(n, k, A, inverses, b)
