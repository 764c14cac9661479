"""What a compiled filter sees of a model and a tuning: addresses of code, layout, numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import types

from .jit import C1, F1, F2, caller, f64, flags, floats, i64, ints, jit, matrix

f_signature = types.void(F1, F1, F1, f64, F1)
f_complex_signature = types.void(C1, F1, F1, f64, C1)
F_signature = types.void(F1, F1, F1, f64, F2)
h_signature = types.void(F1, F1, F1, F1)
h_complex_signature = types.void(C1, F1, F1, C1)
H_signature = types.void(F1, F1, F1, F2)
Q_signature = types.void(F1, F1, F1, F1, f64, F2)
shape_signature = types.void(F1, F1, F1)
log_likelihood_signature = f64(F1, F1, F1, F1, F1)

call_f = caller(f_signature)
call_f_complex = caller(f_complex_signature)
call_F = caller(F_signature)
call_h = caller(h_signature)
call_h_complex = caller(h_complex_signature)
call_H = caller(H_signature)
call_Q = caller(Q_signature)
call_shape = caller(shape_signature)
call_log_likelihood = caller(log_likelihood_signature)


class Context(NamedTuple):
    """All that a compiled filter may know: the model's code and layout, the tuning, the options. Never written to.

    Plain numbers: sizes, modes, and addresses of code and of arrays, which the functions below turn into views.
    Passing forty numbers on costs nothing; passing twenty counted arrays costs more than a small filter's step.
    """

    nx: Any
    nu: Any
    n_parameters: Any
    n_noises: Any
    f: Any
    f_complex: Any
    F: Any
    F_mode: Any
    Q: Any
    Q_varies: Any
    each_state: Any
    shape: Any
    h: Any
    h_complex: Any
    H: Any
    H_mode: Any
    log_likelihood: Any
    n_sensors: Any
    row_start: Any
    row_count: Any
    n_rows: Any
    circular_x: Any
    circular_y: Any
    noise_state: Any
    noise_states: Any
    max_step: Any
    prior_mean: Any
    prior_cov: Any
    prior_rows: Any
    linear_states: Any
    n_linear: Any
    sampled_states: Any
    n_sampled: Any
    jump: Any
    mode: Any
    n_modes: Any
    p: Any
    q: Any
    r: Any
    used: Any
    gate: Any
    width: Any
    options: Any
    n_options: Any
    pairs: Any
    n_pairs: Any
    shown: Any
    n_shown: Any
    prepared: Any
    n_prepared: Any
    seed: Any


context_type = types.NamedTuple(tuple(f64 if name == "max_step" else i64 for name in Context._fields), Context)


@jit
def parameters(context):
    """The model's parameters p."""
    return floats(context.p, context.n_parameters)


@jit
def process_variances(context):
    """q (nw,): the variance that each process noise adds in a second."""
    return floats(context.q, context.n_noises)


@jit
def sensor_rows(context, sensor):
    """A sensor's first row among all rows, and how many it has."""
    return ints(context.row_start, context.n_sensors)[sensor], ints(context.row_count, context.n_sensors)[sensor]


@jit
def sensor_variances(context, sensor):
    """r (ny,): the variances of one sensor's rows."""
    first, count = sensor_rows(context, sensor)
    return floats(context.r, context.n_rows)[first : first + count]


@jit
def circular_states(context):
    """For each state, whether it is an angle (int8)."""
    return flags(context.circular_x, context.nx)


@jit
def circular_rows(context, sensor):
    """For each row of a sensor, whether it is an angle (int8)."""
    first, count = sensor_rows(context, sensor)
    return flags(context.circular_y, context.n_rows)[first : first + count]


@jit
def options(context):
    """The numbers that the estimator's `tune` made of its options."""
    return floats(context.options, context.n_options)


@jit
def transition(context, x, u, dt, out):
    """out = f(x, u, p, dt)."""
    call_f(context.f, x, u, parameters(context), dt, out)


@jit
def expect(context, sensor, x, u, out):
    """out = h(x, u, p) of one sensor."""
    call_h(ints(context.h, context.n_sensors)[sensor], x, u, parameters(context), out)


@jit
def add_process_noise(context, x, u, dt, P, scratch):
    """Add Q(x, u, p, q, dt) to P (nx, nx), or q·dt on the diagonal where the model gives no Q."""
    n = context.nx
    q = process_variances(context)
    if context.Q == 0:
        first = ints(context.noise_state, context.n_noises)
        count = ints(context.noise_states, context.n_noises)
        for k in range(q.size):
            for j in range(first[k], first[k] + count[k]):
                P[j, j] += q[k] * dt
        return
    for i in range(n):
        for j in range(n):
            scratch[i, j] = 0.0
    call_Q(context.Q, x, u, parameters(context), q, dt, scratch)
    for i in range(n):
        for j in range(n):
            P[i, j] += scratch[i, j]


@jit
def prior(context):
    """Mean (nx,) and covariance of the prior, (nx, nx), or (1, nx) where it is diagonal."""
    n = context.nx
    rows = context.prior_rows
    return floats(context.prior_mean, n), matrix(floats(context.prior_cov, rows * n), 0, rows, n)


@jit
def linear_states(context):
    """The indices of the states in which the model is linear, given the others."""
    return ints(context.linear_states, context.n_linear)


@jit
def sampled_states(context):
    """The indices of all the other states but the mode, if there is one (`context.mode`, or -1)."""
    return ints(context.sampled_states, context.n_sampled)


@jit
def jump_chances(context, x, u, dt, out):
    """out = the probability of each next mode (n_modes,), `dt` seconds on."""
    call_f(context.jump, x, u, parameters(context), dt, out)


@jit
def shown_states(context):
    """The index of the state in each of the track's columns."""
    return ints(context.shown, context.n_shown)


@jit
def shaped(context, z, out):
    """out = L z: white noise z (nx,) correlated in space as the model says."""
    call_shape(context.shape, z, parameters(context), out)


@jit
def has_own_likelihood(context, sensor):
    """Whether the sensor's noise is given by a function of its own instead of r."""
    return ints(context.log_likelihood, context.n_sensors)[sensor] != 0


@jit
def own_likelihood(context, sensor, y, x, u):
    """log p(y | x) of a sensor that gives it."""
    target = ints(context.log_likelihood, context.n_sensors)[sensor]
    return call_log_likelihood(target, y, x, u, parameters(context), sensor_variances(context, sensor))
