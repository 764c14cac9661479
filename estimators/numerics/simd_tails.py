"""Both tails of a mixture of normal distributions, in simd_ir."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from . import simd_ir
from .simd_exp import exponential
from .simd_ir import LANES

_i64, _f64 = types.int64, types.float64

_MIDDLE = 3.0
"""Distance that becomes the middle of the polynomial's interval."""

_FURTHEST = 40.0
"""z beyond which Φ(-z) is no number but 0."""

_POLYNOMIAL = (
    0.486055799325, -0.0965267397013, -0.0164326119683, 0.0451634429564, -0.0227244513428, 0.00116405373921,
    0.00298669728293, -0.000365392182978, -0.000474006716002, 3.57751049287e-05, 5.97190541575e-05,
)  # fmt: skip
"""(1 + z) e^(z²/2) Φ(-z) in powers of (z - 3) / (z + 3), z ≥ 0: Chebyshev, degree 10, within 1.4e-8 of the value.

Form after Shepherd & Laframboise (1981), doi:10.1090/S0025-5718-1981-0595058-X."""


def _beyond(builder: Any, z: Any) -> Any:
    """Φ(-z) for z ≥ 0, a number or a vector of them, within 2e-8 of the value."""
    kind = z.type
    wide = isinstance(kind, ir.VectorType)

    def number(value: float) -> Any:
        return ir.Constant(kind, [value] * LANES if wide else value)

    z = builder.select(builder.fcmp_ordered(">", z, number(_FURTHEST)), number(_FURTHEST), z)
    above = builder.fadd(z, number(_MIDDLE))
    one = builder.fadd(z, number(1.0))
    # One division: 1 / above and 1 / one are products with 1 / (above one).
    inverse = builder.fdiv(number(1.0), builder.fmul(above, one))
    t = builder.fmul(builder.fmul(builder.fsub(z, number(_MIDDLE)), one), inverse)
    value = number(_POLYNOMIAL[-1])
    for coefficient in _POLYNOMIAL[-2::-1]:
        value = simd_ir.multiply_add(builder, value, t, number(coefficient))
    value = builder.fmul(value, builder.fmul(above, inverse))
    return builder.fmul(value, exponential(builder, builder.fmul(number(-0.5), builder.fmul(z, z))))


@intrinsic
def add_tails(typing_context: Any, n: Any, d: Any, shift: Any, scale: Any, w: Any, tails: Any) -> Any:
    """tails[0] += Σ w[:n] Φ(z) and tails[1] += Σ w[:n] Φ(-z) of z = scale (d[:n] + shift)."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, shift, scale = given[0], given[2], given[3]
        d, w, tails = (simd_ir.pointer(builder, given[k]) for k in (1, 4, 5))
        wide_shift, wide_scale = simd_ir.broadcast(builder, shift), simd_ir.broadcast(builder, scale)
        wide = [cgutils.alloca_once(builder, simd_ir.VECTOR) for _ in range(2)]
        for total in wide:
            builder.store(simd_ir.ZERO, total)
        numbers = [builder.gep(tails, [simd_ir.constant(k)]) for k in range(2)]

        def add(deviation: Any, weight: Any, shift: Any, scale: Any, totals: list[Any]) -> None:
            kind = deviation.type
            vector = isinstance(kind, ir.VectorType)
            zero = ir.Constant(kind, [0.0] * LANES if vector else 0.0)
            z = builder.fmul(scale, builder.fadd(deviation, shift))
            positive = builder.fcmp_ordered(">", z, zero)
            beyond = builder.fmul(weight, _beyond(builder, builder.select(positive, z, builder.fsub(zero, z))))
            within = builder.fsub(weight, beyond)
            for total, share in zip(
                totals,
                (builder.select(positive, within, beyond), builder.select(positive, beyond, within)),
                strict=True,
            ):
                builder.store(builder.fadd(builder.load(total), share), total)

        simd_ir.in_vectors(
            builder,
            n,
            lambda i: add(simd_ir.load(builder, d, i), simd_ir.load(builder, w, i), wide_shift, wide_scale, wide),
            lambda i: add(builder.load(builder.gep(d, [i])), builder.load(builder.gep(w, [i])), shift, scale, numbers),
        )
        for total, number in zip(wide, numbers, strict=True):
            summed = simd_ir.sum_of(builder, builder.load(total))
            builder.store(builder.fadd(builder.load(number), summed), number)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _f64, _f64, _i64, _i64), codegen
