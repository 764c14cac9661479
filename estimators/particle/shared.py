"""What the particle filters share: a weighted cloud as a flat state, work in blocks, moments, recovery.

The state is a head of `HEAD` numbers, which states are circular (nx,), the mean (nx,) and covariance (nx, nx) of the
last reading's posterior, the log weights (N,), and N records: the particle x (nx,), and in some filters a covariance
P (nx, nx) of its own.

Members are worked on in blocks of `BLOCK`. A block's sums are added in the order of its members, the blocks' in the
order of the blocks, and randomness goes by place; so the bits are the same on any number of threads.

Sources: Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015; Arulampalam, Maskell, Gordon & Clapp (2002),
doi:10.1109/78.978374.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..compiled.context import circular_states, shown_states
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, belief_root
from ..estimator import Option, Options
from ..numerics.jit import floats, ints, jit, matrix
from ..numerics.linalg import wrap
from ..numerics.peaks import Mode, modes_of
from ..numerics.random import key_of, normal
from ..numerics.simd import dot, total, weighted
from ..numerics.simd_exp import exp_minus
from .mode_draws import any_mode, jump_key, nearest_mode
from .resampling import SCHEME_NAMES

DRAWS, SETTLED, EQUAL, ESS, RECOVERIES, RESAMPLED, _SPARE, _SPARE_TOO = range(8)
"""Head of the state: predictions and updates so far; whether mean and covariance are up to date;
whether all weights are equal; effective sample size; clouds that had to be recovered; clouds resampled."""

HEAD = 8
BLOCK = 1024
THREADED_FROM = 16_384
"""Members from which threads gain more than they cost."""

MEMBERS, FRACTION, SCHEME, THREADS, BLOCK_CODE, EXTRA, DUPLICATES = range(7)
"""Positions in the context's options; `EXTRA` is the kernel's width or a proposal, `DUPLICATES` whom a kernel moves."""

PROCESS, START, RESAMPLE, JITTER, RECOVER, PROPOSE = range(6)
"""Streams of randomness; see numerics/random.py."""

OPTIONS = (
    Option("particles", 2000, 2, 1e7, "", "number of particles"),
    Option("fraction", 0.5, 0.0, 1.0, "", "resample when the effective sample size falls under this part of them"),
    Option.choice("resampling", SCHEME_NAMES, "how many children each particle gets"),
)


def members(options: Options) -> int:
    """Number of particles."""
    return int(options["particles"])


def blocks_of(n: int) -> int:
    """Blocks that n members make."""
    return -(-n // BLOCK)


def sized(record: Callable[[int], int]) -> Callable[[Options, int], int]:
    """`state_size` of a filter whose records hold `record(nx)` numbers."""

    def state_size(options: Options, nx: int) -> int:
        return at_weights(nx) + members(options) * (1 + record(nx))

    return state_size


@jit
def at_weights(nx):
    """Where the log weights stand in the state."""
    return HEAD + 2 * nx + nx * nx


def cloud(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights (N,), which sum to 1, and records (N, record) of a state; views where they can be."""
    n = members(options)
    at = at_weights(nx)
    log_w = state[at : at + n]
    w = np.exp(log_w - np.max(log_w))
    return w / np.sum(w), state[at + n :].reshape(n, -1)


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (nx,) and covariance (nx, nx) of a state."""
    mean, cov = np.empty(nx), np.empty((nx, nx))
    cloud_moments(state, nx, members(options), mean, cov)
    return mean, cov


DRAWN = 2000
"""Particles that a view is given at most."""


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Particles to draw (k, nx), k ≤ `DRAWN`, of equal weight: picked by weight at even steps, or all if equal."""
    n = members(options)
    drawn = min(n, DRAWN)
    if state[EQUAL]:
        at = at_weights(nx) + n
        return state[at:].reshape(n, -1)[np.arange(drawn) * n // drawn, :nx]
    w, records = cloud(options, state, nx)
    picked = np.searchsorted(np.cumsum(w), (np.arange(drawn) + 0.5) / drawn)
    return records[np.minimum(picked, n - 1), :nx]


def block(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """A view of the records (N, record) in a state."""
    n = members(options)
    return state[at_weights(nx) + n :].reshape(n, -1)


def modes(options: Options, state: np.ndarray, nx: int) -> list[Mode]:
    """The peaks of the cloud."""
    return modes_of(points(options, state, nx), state[HEAD : HEAD + nx] != 0.0)


def recoveries(state: np.ndarray) -> int:
    """Clouds that were widened, or drawn anew, since the filter started."""
    return int(state[RECOVERIES])


@jit
def log_weights(state, nx, n):
    """The log weights (N,); their exponentials sum to 1 after a reading, to less if particles were lost since."""
    return floats(state.ctypes.data + 8 * at_weights(nx), n)


@jit
def records_of(state, nx, n):
    """The records (N, record)."""
    at = at_weights(nx) + n
    return matrix(state, at, n, (state.size - at) // n)


@jit
def settled_moments(state, nx):
    """The kept mean (nx,) and covariance (nx, nx)."""
    return floats(state.ctypes.data + 8 * (HEAD + nx), nx), matrix(state, HEAD + 2 * nx, nx, nx)


CHUNK = 64
"""Members whose deviations are laid out by row before they are summed: long loops, few of them."""


@jit
def add_chunk(D, n, m, sums):
    """Add n members to the sums: Σw, Σw², and at 4 the m sums Σ w d, then the lower triangle of Σ w d dᵀ.

    D (m + 2, CHUNK) holds the weights in row m and the deviations in the rows above; row m + 1 is scratch.
    """
    row = D.shape[1] * 8
    first = D.ctypes.data
    w = first + m * row
    a = w + row
    sums[0] += total(n, w)
    sums[1] += dot(n, w, w)
    for i in range(m):
        sums[4 + i] += weighted(n, w, first + i * row, a)
        for j in range(i + 1):
            sums[4 + m + i * m + j] += dot(n, a, first + j * row)


@jit
def add_members(circles, w, records, reference, D, sums):
    """Add particles of weights `w`, and their own covariances if they have any, to the sums of the cloud's moments.

    `circles` (nx,) tells the circular states; D (nx + 2, CHUNK) is scratch.
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
            if circles[j] != 0.0:
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
def finish_moments(state, sums, reference, mean, cov):
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
        if state[HEAD + i] != 0.0:
            mean[i] = wrap(mean[i])


@jit
def cloud_moments(state, nx, n, mean, cov):
    """Weighted mean and covariance of the cloud, about its heaviest particle, so that angles do not tear.

    A circular state's mean is that of the deviations from the heaviest particle, wrapped: the intrinsic mean of any
    cloud that does not reach around the circle.
    """
    if state[SETTLED] != 0.0:
        kept_mean, kept_cov = settled_moments(state, nx)
        mean[:] = kept_mean
        cov[:] = kept_cov
        return
    log_w = log_weights(state, nx, n)
    records = records_of(state, nx, n)
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
            exp_minus(last - first, log_w[first:].ctypes.data, top, w.ctypes.data)
        add_members(state[HEAD : HEAD + nx], w[: last - first], records[first:last], reference, D, sums)
    finish_moments(state, sums, reference, mean, cov)


@jit
def describe(context, state, mean, std, cross):
    """Mean, standard deviation and the configured covariances."""
    n = context.nx
    x, cov = np.empty(n), np.empty((n, n))
    cloud_moments(state, n, int(numbers(context)[MEMBERS]), x, cov)
    shown = shown_states(context)
    for k in range(mean.size):
        i = shown[k]
        mean[k] = x[i]
        std[k] = np.sqrt(cov[i, i])
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for k in range(cross.size):
        cross[k] = cov[pairs[2 * k], pairs[2 * k + 1]]


@jit
def wrap_record(circular, x):
    """Bring the circular states of a particle back to ±π."""
    for j in range(circular.size):
        if circular[j] != 0 and not (-np.pi <= x[j] < np.pi):
            x[j] = wrap(x[j])


@jit
def scatter(context, mean, root, key, records):
    """Draw every particle from N(mean, L Lᵀ), certain of itself."""
    nx = mean.size
    circular = circular_states(context)
    z = np.empty(nx)
    mode = context.mode
    variance = 0.0
    for k in range(mode + 1):
        variance += root[mode, k] * root[mode, k]
    for i in range(records.shape[0]):
        for j in range(nx):
            z[j] = normal(key, np.uint64(i * nx + j))
            records[i, j] = mean[j]
        for j in range(nx, records.shape[1]):
            records[i, j] = 0.0
        add_noise(root, z, records[i, :nx])
        if mode >= 0:
            records[i, mode] = nearest_mode(context, records[i, mode], mean[mode], np.sqrt(variance))
        wrap_record(circular, records[i])


@jit
def restart(context, mean, cov, index, stream, state):
    """A cloud drawn from N(mean, cov), of equal weights; the head's counters stay."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    root = np.empty((nx, nx))
    belief_root(cov, root)
    scatter(context, mean, root, key_of(context.seed, index, stream), records_of(state, nx, n))
    weigh_equally(state, nx, n)
    state[SETTLED] = 0.0


@jit
def weigh_equally(state, nx, n):
    """Give every particle the weight 1/N."""
    log_w = log_weights(state, nx, n)
    equal = -np.log(n)
    for i in range(n):
        log_w[i] = equal
    state[EQUAL] = 1.0
    state[ESS] = n


@jit
def start(context, mean, cov, state):
    """The cloud that stands for N(mean, cov): drawn from it, the same whenever the filter starts."""
    nx = context.nx
    circular = circular_states(context)
    for i in range(HEAD):
        state[i] = 0.0
    for j in range(nx):
        state[HEAD + j] = circular[j]
    restart(context, mean, cov, 0, START, state)


@jit
def next_draw(state):
    """Number this prediction or update among all of the state's, and return the number: the place of its draws.

    The count is part of the state, so a rewind takes it back, sub-steps of one event (`max_step`) differ, and queries,
    which work on a copy, change no draw of the estimate.
    """
    state[DRAWS] += 1.0
    state[SETTLED] = 0.0
    return int(state[DRAWS])


SEED = 1e-6
"""Part of the prior's variances from which a cloud without any spread widens."""


@jit
def recover(context, index, state):
    """Widen a cloud in which no particle explains the reading: each moves by a draw from the cloud's own covariance.

    The covariance doubles with every such reading, until particles reach what the sensors say; copies of one particle
    begin at the part `SEED` of the prior's; each takes any mode. A cloud without any weight left, all its particles
    beyond the floating-point numbers, starts again from the prior.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    state[RECOVERIES] += 1.0
    records = records_of(state, nx, n)
    mean = np.empty(nx)
    cov = np.empty((nx, nx))
    cloud_moments(state, nx, n, mean, cov)
    prior = matrix(floats(context.prior_cov, nx * nx), 0, nx, nx)
    finite = True
    for i in range(nx):
        finite = finite and np.isfinite(mean[i]) and np.isfinite(cov[i, i])
        cov[i, i] = max(cov[i, i], SEED * prior[i, i])
    if not finite:
        restart(context, floats(context.prior_mean, nx), prior, index, RECOVER, state)
        return
    root = np.empty((nx, nx))
    belief_root(cov, root)
    key = key_of(context.seed, index, RECOVER)
    spread_by(context, root, key, 0, records)
    if context.mode >= 0:
        for i in range(n):
            records[i, context.mode] = any_mode(context, jump_key(key), i)
    state[SETTLED] = 0.0


@jit
def spread_by(context, root, key, first, records):
    """Move each particle by L z, z ~ N(0, I), but for its mode; `first` is the member of the first record."""
    nx = root.shape[0]
    mode = context.mode
    kept = 0.0
    circular = circular_states(context)
    z = np.empty(nx)
    for i in range(records.shape[0]):
        for j in range(nx):
            z[j] = normal(key, np.uint64((first + i) * nx + j))
        if mode >= 0:
            kept = records[i, mode]
        add_noise(root, z, records[i, :nx])
        if mode >= 0:
            records[i, mode] = kept
        wrap_record(circular, records[i])


@jit
def add_up(blocks, count, stride, sums):
    """Sum the blocks' sums in their order, and keep the highest maximum with its member.

    `blocks` holds `count` blocks of `stride` numbers, which begin with their sums.
    """
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    for b in range(count):
        at = b * stride
        for k in range(sums.size):
            if k != 2 and k != 3:
                sums[k] += blocks[at + k]
        if blocks[at + 2] > sums[2]:
            sums[2] = blocks[at + 2]
            sums[3] = blocks[at + 3]
