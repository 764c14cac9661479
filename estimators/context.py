"""What a compiled filter sees of a model and a tuning: addresses of code, layout, numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import types

from .jit import B1, C1, F1, F2, I1, I2, caller, f64, i64, jit

f_signature = types.void(F1, F1, F1, f64, F1)
f_complex_signature = types.void(C1, F1, F1, f64, C1)
F_signature = types.void(F1, F1, F1, f64, F2)
h_signature = types.void(F1, F1, F1, F1)
h_complex_signature = types.void(C1, F1, F1, C1)
H_signature = types.void(F1, F1, F1, F2)
Q_signature = types.void(F1, F1, F1, F1, f64, F2)

call_f = caller(f_signature)
call_f_complex = caller(f_complex_signature)
call_F = caller(F_signature)
call_h = caller(h_signature)
call_h_complex = caller(h_complex_signature)
call_H = caller(H_signature)
call_Q = caller(Q_signature)


class Context(NamedTuple):
    """All that a compiled filter may know: the model's code and layout, the tuning, the options. Never written to."""

    f: Any
    f_complex: Any
    F: Any
    F_mode: Any
    Q: Any
    h: Any
    h_complex: Any
    H: Any
    H_mode: Any
    row_start: Any
    row_count: Any
    circular_x: Any
    circular_y: Any
    noise_state: Any
    max_step: Any
    prior_mean: Any
    prior_cov: Any
    p: Any
    q: Any
    r: Any
    used: Any
    gate: Any
    options: Any
    pairs: Any
    seed: Any


context_type = types.NamedTuple(
    (i64, i64, i64, i64, i64, I1, I1, I1, I1, I1, I1, B1, B1, I1, f64, F1, F2, F1, F1, F1, B1, F1, F1, I2, i64),
    Context,
)


@jit
def add_process_noise(context, x, u, dt, P, scratch):
    """Add Q(x, u, p, q, dt) to P (nx, nx), or q·dt on the diagonal where the model gives no Q."""
    n = P.shape[0]
    if context.Q == 0:
        for k in range(context.noise_state.size):
            j = context.noise_state[k]
            P[j, j] += context.q[k] * dt
        return
    for i in range(n):
        for j in range(n):
            scratch[i, j] = 0.0
    call_Q(context.Q, x, u, context.p, context.q, dt, scratch)
    for i in range(n):
        for j in range(n):
            P[i, j] += scratch[i, j]
