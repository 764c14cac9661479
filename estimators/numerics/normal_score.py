"""Normal scores e = Φ⁻¹(F(y)), by which any continuous prediction F of a number y gives e ~ N(0, 1) where it is right.

Sources: Rosenblatt (1952), doi:10.1214/aoms/1177729394; Dawid (1984), doi:10.2307/2981683, for the judgement of
sequential forecasts by it; Smith (1985), doi:10.1002/for.3980040305, for the step to normal scores.

`add_tails` is vector code: 118 ns for 50 members against 407 for a loop over math.erfc, 1.8 µs against 8.6 for 1,000.
"""

from __future__ import annotations

import math

import numpy as np

from .jit import inlined, jit
from .simd_ir import Lanes, Value, exponential, in_vectors, integer, vector_code

FURTHEST = 8.0
"""|e| at most: a probability of 6e-16, beyond which no prediction means what it says."""

_EXACT = 1e8
"""Degrees of freedom from which a Student t is a normal variable, to a double's digits where |e| ≤ `FURTHEST`."""

# Numerator and denominator of AS 241, about the median, in the tails, and far out in them.
_A = (
    3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3, 1.3731693765509461125e4,
    4.5921953931549871457e4, 6.7265770927008700853e4, 3.3430575583588128105e4, 2.5090809287301226727e3,
)  # fmt: skip
_B = (
    1.0, 4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3,
    2.1213794301586595867e4, 3.9307895800092710610e4, 2.8729085735721942674e4, 5.2264952788528545610e3,
)  # fmt: skip
_C = (
    1.42343711074968357734e0, 4.63033784615654529590e0, 5.76949722146069140550e0, 3.64784832476320460504e0,
    1.27045825245236838258e0, 2.41780725177450611770e-1, 2.27238449892691845833e-2, 7.74545014278341407640e-4,
)  # fmt: skip
_D = (
    1.0, 2.05319162663775882187e0, 1.67638483018380384940e0, 6.89767334985100004550e-1,
    1.48103976427480074590e-1, 1.51986665636164571966e-2, 5.47593808499534494600e-4, 1.05075007164441684324e-9,
)  # fmt: skip
_E = (
    6.65790464350110377720e0, 5.46378491116411436990e0, 1.78482653991729133580e0, 2.96560571828504891230e-1,
    2.65321895265761230930e-2, 1.24266094738807843860e-3, 2.71155556874348757815e-5, 2.01033439929228813265e-7,
)  # fmt: skip
_F = (
    1.0, 5.99832206555887937690e-1, 1.36929880922735805310e-1, 1.48753612908506148525e-2,
    7.86869131145613259100e-4, 1.84631831751005468180e-5, 1.42151175831644588870e-7, 2.04426310338993978564e-15,
)  # fmt: skip


@inlined
def _fraction(numerator, denominator, x):
    """A quotient of two polynomials of degree 7."""
    above = 0.0
    below = 0.0
    for k in range(7, -1, -1):
        above = above * x + numerator[k]
        below = below * x + denominator[k]
    return above / below


@jit
def tail_quantile(p):
    """The z ≥ 0 beyond which a standard normal variable lies with a probability of p ≤ ½, to about 16 digits.

    Source: Wichura (1988), Algorithm AS 241, doi:10.2307/2347330.
    """
    q = 0.5 - p
    if q <= 0.425:
        return q * _fraction(_A, _B, 0.180625 - q * q)
    r = math.sqrt(-math.log(p))
    return _fraction(_C, _D, r - 1.6) if r <= 5.0 else _fraction(_E, _F, r - 5.0)


@jit
def normal_score(lower, upper):
    """Φ⁻¹(F) of F = lower / (lower + upper), from the smaller of the two, so that no digit of a tail is lost.

    Never beyond `FURTHEST`, and NaN if both are 0 or either is NaN.
    """
    whole = lower + upper
    if not whole > 0.0:
        return np.nan
    p = min(lower, upper) / whole
    e = min(tail_quantile(p), FURTHEST) if p > 0.0 else FURTHEST
    return -e if lower < upper else e


@jit
def student_score(t, dof):
    """Φ⁻¹(T(t)) of Student's distribution T with `dof` degrees of freedom, in closed form.

    e = (8 dof + 1) / (8 dof + 3) · √(dof log(1 + t² / dof)), with the sign of t. For |e| ≤ 3 it is 0.006 off at 9
    degrees of freedom, 0.0002 at 49, and 0.2 at a single one; for |e| ≤ 6 it is 0.05 off at 9 and 0.002 at 49.

    Source: Wallace (1959), Bounds on normal approximations to Student's and the chi-square distributions, The Annals of
    Mathematical Statistics 30, 1121-1130.
    """
    e = abs(t)
    if dof < _EXACT:
        e = (8.0 * dof + 1.0) / (8.0 * dof + 3.0) * math.sqrt(dof * math.log1p(t * t / dof))
    return math.copysign(min(e, FURTHEST), t) if np.isfinite(e) else np.nan


@jit
def add_tail(z, w, tails):
    """tails[0] += w Φ(z), tails[1] += w Φ(-z)."""
    beyond = 0.5 * math.erfc(abs(z) * math.sqrt(0.5))
    within = 1.0 - beyond
    tails[0] += w * (within if z > 0.0 else beyond)
    tails[1] += w * (beyond if z > 0.0 else within)


_MIDDLE = 3.0
"""Distance that becomes the middle of the polynomial's interval."""

_MAX_TAIL_Z = 40.0
"""z beyond which Φ(-z) is 0 in float64."""

_POLYNOMIAL = (
    0.486055799325, -0.0965267397013, -0.0164326119683, 0.0451634429564, -0.0227244513428, 0.00116405373921,
    0.00298669728293, -0.000365392182978, -0.000474006716002, 3.57751049287e-05, 5.97190541575e-05,
)  # fmt: skip
"""(1 + z) e^(z²/2) Φ(-z) in powers of (z - 3) / (z + 3), z ≥ 0: Chebyshev, degree 10, within 1.4e-8 of the value.

Form after Shepherd & Laframboise (1981), doi:10.1090/S0025-5718-1981-0595058-X."""


def _beyond(v: Lanes, z: Value) -> Value:
    """Return Φ(-z) for z ≥ 0, within 2e-8 of the value."""
    builder, number = v.builder, v.constant
    z = builder.select(builder.fcmp_ordered(">", z, number(_MAX_TAIL_Z)), number(_MAX_TAIL_Z), z)
    above = builder.fadd(z, number(_MIDDLE))
    one = builder.fadd(z, number(1.0))
    # One division: 1 / above and 1 / one are products with 1 / (above one).
    inverse = builder.fdiv(number(1.0), builder.fmul(above, one))
    t = builder.fmul(builder.fmul(builder.fsub(z, number(_MIDDLE)), one), inverse)
    value = number(_POLYNOMIAL[-1])
    for coefficient in _POLYNOMIAL[-2::-1]:
        value = v.multiply_add(value, t, number(coefficient))
    value = builder.fmul(value, builder.fmul(above, inverse))
    return builder.fmul(value, exponential(v, builder.fmul(number(-0.5), builder.fmul(z, z))))


@vector_code()
def add_tails(v, n, d, shift, scale, w, tails):
    """tails[0] += Σ w[:n] Φ(z) and tails[1] += Σ w[:n] Φ(-z) of z = scale (d[:n] + shift), within 2e-8 of each term."""
    builder = v.builder
    numbers = [builder.gep(tails.data, [integer(k)]) for k in range(2)]
    sums = [v.variable() for _ in range(2)]

    def add(v: Lanes, i: Value) -> None:
        weight, zero = v.load(w.data, i), v.constant(0.0)
        z = builder.fmul(v.spread(scale), builder.fadd(v.load(d.data, i), v.spread(shift)))
        positive = builder.fcmp_ordered(">", z, zero)
        beyond = builder.fmul(weight, _beyond(v, builder.select(positive, z, builder.fsub(zero, z))))
        within = builder.fsub(weight, beyond)
        below, upper = sums if v.wide else numbers
        v.add_to(below, builder.select(positive, within, beyond))
        v.add_to(upper, builder.select(positive, beyond, within))

    in_vectors(v, n, add)
    for number, total in zip(numbers, sums, strict=True):
        builder.store(builder.fadd(builder.load(number), v.sum_of(builder.load(total))), number)
