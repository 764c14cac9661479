"""The bootstrap and the regularised particle filter: particles move by the model and are weighed by the measurement.

x_i ~ p(x | x_i'),  w_i ∝ w_i' p(y | x_i); resampled when the effective sample size is low. NIS is that of the weighted
mean and covariance of h(x_i), so it means the same as a Gaussian filter's; the log-likelihood is that of the particles,
log Σ w_i' p(y | x_i), whose exponential, multiplied over the measurements, is unbiased without a kernel.

Regularised: after resampling each particle x becomes m + √(1 - h²) (x - m) and a draw from a Gaussian kernel, h times
the root of the cloud's covariance, so that the cloud keeps its mean m and covariance, which a kernel alone would widen
by 1 + h² each time. The bandwidth h is the one that is best for a Gaussian cloud, times the option `bandwidth`, at most
1. Optionally only particles that have a sibling move, by the kernel alone: a cloud of several peaks has no particles
near its mean, towards which they would shrink.

Each particle has its own values of the considered states. A measurement weighs the particles with them, so that mean
and covariance of the others account for their uncertainty; then `reconsider` gives them their prior again.

Sources: Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015; Musso, Oudjane & Le Gland (2001), Improving
regularised particle filters, in Sequential Monte Carlo Methods in Practice, doi:10.1007/978-1-4757-3437-9_12; West
(1993), Mixture models, Monte Carlo, Bayesian updating and dynamic models, for the shrinkage.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..compiled.context import (
    circular_rows,
    circular_states,
    expect_points,
    has_own_likelihood,
    own_likelihood,
    sensor_variances,
    transition_points,
)
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, belief_root, has_correlated_rows, independent_rows, noise_root
from ..compiled.verdict import LOG_2PI
from ..estimator import POINTS, TRAJECTORIES, Estimator, Option, Options, SmoothingRule
from ..model.state_space import StateSpaceModel
from ..numerics.jit import ints, jit
from ..numerics.linalg import wrap
from ..numerics.normal_score import add_tails
from ..numerics.random import fill_normals, key_of
from ..numerics.simd import added, all_finite, copied, exp_minus, weigh_squares
from ..numerics.workspace import declare_layout
from ..track import FAILED, GATED, MISSING, USED
from ..tuning import Tuning
from .cloud import (
    CHUNK,
    DUPLICATES,
    EQUAL,
    JITTER,
    MEMBERS,
    OPTIONS,
    PROCESS,
    RESAMPLE,
    SHARED,
    WIDTH,
    add_chunk,
    block,
    clear_sums,
    count_of,
    describe,
    next_draw,
    own_cloud,
    score_cloud,
    sized,
    tails_of,
    tune,
    wrap_record,
)
from .draws import jump, jump_key, reconsider, recover, spread_by, start
from .innovation import about, expected_reading, finite_rows, first_residual, half_square
from .weights import (
    OWN,
    all_lost,
    block_of,
    keep_or_resample,
    normalise,
    phases,
    range_of,
    sweep,
    work_of,
    work_sized,
)

PROPAGATE, WEIGH, SMOOTH = range(OWN, OWN + 3)
"""Phases: x_i ~ p(x | x_i'); p(y | x_i); the kernel of the regularised filter."""


BootstrapRoom, room_at = declare_layout(
    "BootstrapRoom",
    "nx, ny",
    forward=f"{CHUNK}, nx",
    z=f"{CHUNK} * nx",
    expected=f"{CHUNK}, ny",
    L="nx, nx",
    spare="nx, nx",
    F="ny, ny",
    d="ny",
)
"""Scratch of a block for a chunk of members: next states, normal numbers, expected measurements; for noise that depends
on the state a root L and room for it; R = F diag(d) Fᵀ of the finite rows."""


@jit
def room_of(context, shared, b):
    """Return the room of block b."""
    nx, ny = context.nx, context.width
    return room_at(shared.end + b * room_at(0, nx, ny).end, nx, ny)


@jit
def _settle_finite(forward, records, log_w):
    """Move the members whose next state is finite; set the weight of the others to zero; return their number."""
    nx = forward.shape[1]
    lost = 0
    for i in range(log_w.size):
        finite = True
        for j in range(nx):
            finite &= np.isfinite(forward[i, j])
        if finite:
            for j in range(nx):
                records[i, j] = forward[i, j]
        else:
            log_w[i] = -np.inf
            lost += 1
    return lost


@jit
def propagate_block(context, u, dt, sensor, y, key, value, state, work, number):
    """x ← f(x) + L z for a block's members; one that becomes infinite or NaN stays put and gets weight zero.

    The block's first sum is the number of members lost.
    """
    nx, n = context.nx, count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    room = room_of(context, shared, number)
    records, log_w = cloud.records, cloud.log_w
    forward, z = room.forward, room.z
    varies = context.Q_varies != 0
    L = room.L if varies else shared.L
    circular = circular_states(context)
    diagonal = context.Q == 0
    noises = context.n_noises if diagonal else nx
    noisy = ints(context.noise_state, context.n_noises)
    angles = np.any(circular)
    jumps = context.jump != 0
    chances = np.empty(context.n_modes)
    first, last = range_of(number, n)
    lost = 0
    for begin in range(first, last, CHUNK):
        count = min(CHUNK, last - begin)
        if jumps:
            for i in range(begin, begin + count):
                jump(context, records[i], u, dt, jump_key(key), i, chances)
        transition_points(context, records[begin : begin + count], u, dt, forward)
        fill_normals(key, np.uint64(begin) * np.uint64(noises), count * noises, z)
        if diagonal:
            for k in range(noises):
                j = noisy[k]
                scale = L[j, j]
                for i in range(count):
                    forward[i, j] += scale * z[i * noises + k]
        else:
            for i in range(count):
                if varies:
                    noise_root(context, records[begin + i], u, dt, L, room.spare)
                add_noise(L, z[i * noises :], forward[i])
        if all_finite(count * nx, forward):
            copied(count * nx, forward[0], records[begin])
        else:
            lost += _settle_finite(forward, records[begin : begin + count], log_w[begin : begin + count])
        if angles:
            for i in range(count):
                wrap_record(circular, records[begin + i])
    block_of(context, shared, number).sums[0] = lost


@jit
def weigh_block(context, u, dt, sensor, y, key, value, state, work, number):
    """joint = log w + log p(y | x), and the sums of the residuals' mean and covariance under the predicted weights.

    The sums are about `first_residual` and include the two tails of each row, see `score_rows`. A density that is NaN
    counts as zero.
    """
    n = count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    room, block = room_of(context, shared, number), block_of(context, shared, number)
    joint, log_w, records = shared.joint, cloud.log_w, cloud.records
    expected, D, sums = room.expected, block.D, block.sums
    equal = state[EQUAL] != 0.0
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    own = has_own_likelihood(context, sensor)
    correlated = has_correlated_rows(context, sensor)
    clear_sums(sums)
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
        joint[begin : begin + count] = constant
        k = 0
        for row in range(ny):
            if not np.isfinite(y[row]):
                continue
            # Row `row` moves up to k ≤ row.
            d = D[k]
            weight = 0.0 if correlated else 0.5 / r[row]
            if circular[row] != 0 or correlated:
                for i in range(count):
                    e = D[row, i]
                    if circular[row] != 0:
                        e = wrap(e)
                    if correlated:
                        expected[i, k] = e
                    d[i] = about(e, reference[row], circular[row])
                    joint[begin + i] -= weight * e * e
            else:
                weigh_squares(count, D[row], weight, reference[row], joint[begin:], d)
            k += 1
        if correlated:
            for i in range(count):
                joint[begin + i] -= half_square(room.F, room.d, m, expected[i])
        if own:
            for i in range(count):
                joint[begin + i] = own_likelihood(context, sensor, y, records[begin + i, : context.nx], u)
        # Row m + 1 is free for the weights until the sums are made.
        if equal:
            D[m + 1, :count] = 1.0
        else:
            exp_minus(count, log_w[begin:], 0.0, D[m + 1])
        copied(count, D[m + 1], D[m])
        added(count, joint[begin:], log_w[begin:], joint[begin:])
        # A density that is NaN, or an expectation: the particle is out, and out of the sums.
        if not all_finite(count, joint[begin:]):
            for i in range(count):
                if not -np.inf < joint[begin + i] < np.inf:
                    joint[begin + i] = -np.inf
                    for k in range(m):
                        if not np.isfinite(D[k, i]):
                            D[m, i] = 0.0
                            D[k, i] = 0.0
        for i in range(begin, begin + count):
            if joint[i] > top:
                top = joint[i]
                sums[3] = i
        if not own:
            k = 0
            for row in range(ny):
                if np.isfinite(y[row]):
                    add_tails(count, D[k], reference[row], 1.0 / np.sqrt(r[row]), D[m], tails[2 * k :])
                    k += 1
        add_chunk(D, count, m, sums)
    sums[2] = top


@jit
def shrink(context, mean, records):
    """x ← m + √(1 - h²) (x - m), but for its mode."""
    h = numbers(context)[WIDTH]
    circular = circular_states(context)
    a = np.sqrt(1.0 - h * h)
    for i in range(records.shape[0]):
        for j in range(mean.size):
            if j != context.mode:
                d = records[i, j] - mean[j]
                records[i, j] = mean[j] + a * (wrap(d) if circular[j] != 0 else d)


@jit
def smooth_block(context, u, dt, sensor, y, key, value, state, work, number):
    """x ← m + √(1 - h²) (x - m) + L z, or x + L z of siblings: a draw from the kernel of the regularised filter."""
    n = count_of(context)
    first, last = range_of(number, n)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    records = cloud.records
    every = numbers(context)[DUPLICATES] == 0.0
    # Siblings stand side by side: runs of members that have one move, or the whole block.
    ancestors = shared.ancestors
    begin = first
    for i in range(first, last + 1):
        alone = i == last or not (
            every or (i > 0 and ancestors[i - 1] == ancestors[i]) or (i + 1 < n and ancestors[i + 1] == ancestors[i])
        )
        if alone:
            if i > begin:
                if every:
                    shrink(context, cloud.mean, records[begin:i])
                spread_by(context, shared.L, key, begin, records[begin:i])
            begin = i + 1


@jit
def predict(context, u, dt, index, state, work):
    """x_i ← f(x_i) + w_i, w_i ~ N(0, Q). Source: Gordon, Salmond & Smith (1993)."""
    index = next_draw(state)
    shared = work_of(context, work)
    if context.Q_varies == 0:
        noise_root(context, own_cloud(context, state).records[0], u, dt, shared.L, shared.spare)
    sweep(PROPAGATE, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    if all_lost(context, state, work):
        recover(context, index, state)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """w_i ← w_i p(y | x_i), and resampling where few particles carry the weight.

    If no particle explains the measurement, the verdict is `FAILED`, the measurement is not used, and the cloud is
    widened (see `recover`).
    """
    if finite_rows(y, sensor_variances(context, sensor).size) == 0:
        return MISSING
    # log w_i + log p(y | x_i), and ν = y - Σ w h(x), S = Σ w (h(x) - ȳ)(h(x) - ȳ)ᵀ + R for the gate
    index, verdict = expected_reading(WEIGH, context, u, sensor, y, state, work, innovation, innovation_std, score)
    # w_i ← w_i p(y | x_i) / Σ w p(y | x), and log p(y) = log Σ w p(y | x)
    verdict = conclude(context, index, verdict, state, work, score)
    if verdict == FAILED:
        recover(context, index, state)
    return verdict


@jit
def conclude(context, index, verdict, state, work, score):
    """Make the joint weights of a used measurement the state's; return the verdict, FAILED if none explains it.

    The log-likelihood of a rejected measurement stays that of its Gaussian.
    """
    log_sum = normalise(context, state, work)
    if verdict != GATED:
        score[2] = log_sum if log_sum > -np.inf else np.nan
    if verdict != USED:
        return verdict
    if not log_sum > -np.inf:
        return FAILED
    drawn = keep_or_resample(context, key_of(context.seed, index, RESAMPLE), log_sum, state, work)
    if drawn and numbers(context)[WIDTH] > 0.0:
        smooth(context, key_of(context.seed, index, JITTER), state, work)
    reconsider(context, index, state)
    score_cloud(state, score)
    return USED


@jit
def smooth(context, key, state, work):
    """Shrink the cloud and move each particle by a draw from the kernel, with the root L of h² times its covariance."""
    L = work_of(context, work).L
    belief_root(own_cloud(context, state).cov, L)
    L *= numbers(context)[WIDTH]
    sweep(SMOOTH, context, state, 0.0, 0, state, key, 0.0, state, work)


BANDWIDTH = Option("bandwidth", 0.5, 0.0, 100.0, "", "kernel width as a part of the best for a Gaussian cloud")


JITTERED = Option.choice(
    "jitter",
    ("all", "duplicates"),
    "particles that the kernel moves: all, or those with a sibling, which do not shrink to the mean",
)


def tune_regularised(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """Return the numbers of the bootstrap filter, and the kernel width h.

    h = bandwidth · (4 / (nx + 2))^(1/(nx+4)) · N^(-1/(nx+4)), at most 1: Musso, Oudjane & Le Gland (2001), Gaussian
    kernel.
    """
    nx = model.nx
    values = tune(options, model, tuning)
    power = 1.0 / (nx + 4)
    values[DUPLICATES] = options["jitter"]
    values[WIDTH] = min(options["bandwidth"] * (4.0 / (nx + 2)) ** power * values[MEMBERS] ** -power, 1.0)
    return values


PF = Estimator(
    name="pf",
    title="Bootstrap particle filter",
    assumes="nothing but noise that can be drawn and readings that can be scored",
    model_runs="N",
    fails_when="the readings are much sharper than the cloud, or nx is large: few particles carry all the weight",
    source="Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["particles"],
    state_size=sized(lambda nx: nx),
    work_size=work_sized(room_at),
    blocks=block,
    prepare=phases(propagate_block, weigh_block, smooth_block),
    smoothing=SmoothingRule(POINTS, TRAJECTORIES),
    considers=True,
    **SHARED,
)


PF_REG = replace(
    PF,
    name="pf-reg",
    title="Regularised particle filter",
    assumes="as pf, and a posterior with a density: little process noise is no obstacle",
    fails_when="the posterior has sharp structure that the kernel smears",
    source="Musso, Oudjane & Le Gland (2001), doi:10.1007/978-1-4757-3437-9_12",
    options=(*OPTIONS, BANDWIDTH, JITTERED),
    tune=tune_regularised,
)
