"""What (I + A)^(-1/2) makes of one vector, for symmetric positive semidefinite A, without eigenvectors.

A = Hᵀ T H with H a product of reflections and T tridiagonal; and the inverse root is a sum of resolvents,

    (I + T)^(-1/2) ≈ Σ_k w_k ((1 + σ_k) I + T)⁻¹,

to the last bit with a dozen or two of them: the trapezoidal rule on an integral that elliptic functions have smoothed.
Each is a tridiagonal system, and all are solved side by side in simd_ir. Turning the vector by the rotations of a QL
iteration takes ten times as long.

Source: Hale, Higham & Trefethen (2008), Computing A^α, log(A), and related matrix functions by contour integrals,
doi:10.1137/070700607, method 3, with the real form of its elliptic functions; these by Jacobi's theta functions (NIST
Digital Library of Mathematical Functions, 22.2 and 20.2).
"""

from __future__ import annotations

import numpy as np
from numba.core import cgutils
from scipy.special import ellipk, ellipkm1

from .jit import jit
from .simd import add_scaled, dot
from .simd_ir import LANES, integer, vector_code
from .symmetric import begin, tridiagonal
from .workspace import layout

_BLOCKS = 18
"""The finest rule has this many vectors of resolvents; it is good up to `_UP_TO[-1]`."""

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
    """For 1, 2, … vectors of resolvents: the largest 1 + λ at which they are good to the last bit, shifts, weights."""
    # The rule's error is 4 exp(-2 π² count / log(16 condition)), nearly.
    counts = LANES * (np.arange(_BLOCKS) + 1)
    up_to = np.exp(counts / 1.86) / 16.0
    shifts, weights = np.zeros((2, _BLOCKS, counts[-1]))
    for k, (count, condition) in enumerate(zip(counts, up_to, strict=True)):
        shifts[k, :count], weights[k, :count] = _rule(int(count), float(condition))
    return up_to, shifts, weights


_UP_TO, _SHIFTS, _WEIGHTS = _rules()
_SHRINKS = _WEIGHTS / (1.0 + _SHIFTS)
_NO_SHIFT, _ONE = np.zeros(LANES), np.eye(LANES)[0]


@layout
def scratch_of(n: int) -> int:
    """Numbers of scratch that `root_action` takes at order n."""
    return n * (4 + 3 * LANES) + LANES


@vector_code()
def resolve(v, n, d, e, b, blocks, shifts, weights, scratch, out):
    """out[:n] = Σ_k weights[k] (T + shifts[k] I)⁻¹ b, T tridiagonal with diagonal d[:n], and e[1:n] beside it.

    By elimination without exchanges, which is stable where all T + shifts[k] I are positive definite; `LANES` shifts at
    a time, which is what `blocks` counts. e[0] must be 0. `scratch` holds (3 n + 1) LANES numbers.
    """
    builder, lanes, zero = v.builder, integer(LANES), v.constant(0.0)
    factors = scratch.data
    values = builder.gep(factors, [builder.mul(builder.add(n, integer(1)), lanes)])
    sums = builder.gep(values, [builder.mul(n, lanes)])
    inverse, y = v.variable(), v.variable()
    with cgutils.for_range(builder, n) as loop:
        v.store(zero, sums, builder.mul(loop.index, lanes))
    v.store(zero, factors, builder.mul(n, lanes))
    with cgutils.for_range(builder, blocks) as block:
        at = builder.mul(block.index, lanes)
        shift, weight = v.load(shifts.data, at), v.load(weights.data, at)
        builder.store(zero, inverse)
        builder.store(zero, y)
        with cgutils.for_range(builder, n) as loop:
            i, to = loop.index, builder.mul(loop.index, lanes)
            beside = v.entry(e.data, i)
            factor = builder.fmul(beside, builder.load(inverse))
            minus = builder.fneg(factor)
            pivot = v.multiply_add(minus, beside, builder.fadd(v.entry(d.data, i), shift))
            value = v.multiply_add(minus, builder.load(y), builder.fmul(weight, v.entry(b.data, i)))
            inverted = builder.fdiv(v.constant(1.0), pivot)
            builder.store(inverted, inverse)
            builder.store(value, y)
            v.store(factor, factors, to)
            v.store(builder.fmul(value, inverted), values, to)
        builder.store(zero, y)
        with cgutils.for_range(builder, n) as loop:
            to = builder.mul(builder.sub(builder.sub(n, integer(1)), loop.index), lanes)
            factor = builder.fneg(v.load(factors, builder.add(to, lanes)))
            x = v.multiply_add(factor, builder.load(y), v.load(values, to))
            builder.store(x, y)
            v.store(builder.fadd(v.load(sums, to), x), sums, to)
    with cgutils.for_range(builder, n) as loop:
        total = v.sum_of(v.load(sums, builder.mul(loop.index, lanes)))
        builder.store(total, builder.gep(out.data, [loop.index]))


@jit
def root_action(A, n, d, b, g, inverse_root, scratch):
    """b ← f(A) b for symmetric positive semidefinite A, f(λ) = 1/√(1+λ) or (1 - 1/√(1+λ)) / λ.

    The second is Σ w_k / ((1 + σ_k) (1 + λ + σ_k)), from the first's values at 0 and at λ, without a difference.

    Args:
        A: Symmetric, at least (n, n), rows contiguous; is destroyed.
        n: Order.
        d: Scratch (n,).
        b: A vector (n,).
        g: Another, destroyed.
        inverse_root: Whether f is the first, or else the second.
        scratch: `scratch_of` numbers.

    Returns:
        bᵀ (I + A)⁻¹ g of the b given; NaN if a number is not finite.
    """
    half = scratch[2 * n : 3 * n]
    tridiagonal(A, n, d, half, scratch)
    e = scratch[:n]
    x = scratch[3 * n : 4 * n]
    rest = scratch[4 * n :]
    for k in range(n - 2):
        if half[k] != 0.0:
            _reflect(A, n, k, half[k], b)
            _reflect(A, n, k, half[k], g)
    # No eigenvalue is larger than the largest sum of a row (Gershgorin).
    largest = 0.0
    finite = True
    for k in range(n):
        row = abs(d[k]) + abs(e[k]) + (abs(e[k + 1]) if k + 1 < n else 0.0)
        finite = finite and row < np.inf
        largest = max(largest, row)
    if not finite:
        return np.nan
    # Rounding left T's eigenvalues off by so much; none may come out below 0.
    for k in range(n):
        d[k] += 1.0 + 4.0 * _EPSILON * largest
    rule = 0
    while rule < _BLOCKS - 1 and _UP_TO[rule] < 1.0 + largest:
        rule += 1
    resolve(n, d, e, g, 1, _NO_SHIFT, _ONE, rest, x)
    product = dot(n, b, x)
    weights = _WEIGHTS[rule] if inverse_root else _SHRINKS[rule]
    resolve(n, d, e, b, rule + 1, _SHIFTS[rule], weights, rest, x)
    for k in range(n):
        b[k] = x[k]
    for k in range(n - 3, -1, -1):
        if half[k] != 0.0:
            _reflect(A, n, k, half[k], b)
    return product


@jit
def _reflect(A, n, k, half, x):
    """x ← (I - v vᵀ / half) x, with v of row k."""
    first = begin(k)
    v, own = A[k, first:], x[first:]
    add_scaled(n - first, -dot(n - first, v, own) / half, v, own)
