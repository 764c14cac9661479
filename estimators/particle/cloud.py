"""The state of a particle filter: a weighted cloud, its moments, its lineage, and its row of the track.

Sums of moments are added in the order of the members within a block, then in the order of the blocks, so that any
number of threads gives the same bits. They are Σw, Σw², the largest log weight, its member, and from 4 on Σ w d (m,)
and Σ w d dᵀ (m, m) of deviations d from a reference. The last 2 ny are the two tails of the predicted measurement,
Σ w Φ(z) and Σ w Φ(-z), row by row.

Sources: Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015; Arulampalam, Maskell, Gordon & Clapp (2002),
doi:10.1109/78.978374; Jacob, Murray & Rubenthaler (2015), Path storage in the particle filter,
doi:10.1007/s11222-013-9445-x, for the lineage.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..compiled.context import options as numbers
from ..estimator import Option, Options
from ..gaussian.shared import tell
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit, matrix, threaded
from ..numerics.linalg import wrap
from ..numerics.peaks import Peak, peaks_of
from ..numerics.simd import copied, dot, exp_minus, total, weighted
from ..numerics.workspace import WORD, declare_layout, layout, size_of, start_of, view
from ..track import ANCESTORS, EFFECTIVE
from ..tuning import Tuning
from .resampling import SCHEME_NAMES

DRAWS, SETTLED, EQUAL, ESS, RECOVERIES, RESAMPLED, ORIGINS, GENERATIONS = range(8)
"""Head of the state: number of predictions and updates; whether mean and covariance are up to date; whether all weights
are equal; effective sample size; number of recoveries and of resamplings; particles from which the present ones
descend, at the last count, and measurements used since."""

HEAD = 8

MEMBERS, FRACTION, SCHEME, THREADS, WIDTH, DUPLICATES = range(6)
"""Positions in the context's options. `WIDTH` is the kernel width of `pf-reg`, 0 in all others; `DUPLICATES` is whether
the kernel moves only particles that have a sibling."""

PROCESS, START, RESAMPLE, JITTER, RECOVER, DRAW, CONSIDER = range(7)
"""Streams of randomness; see numerics/random.py."""

THREADED_FROM = 16_384
"""Members from which threads gain more than they cost."""

BLOCK = 1024
"""Members whose sums are added by one thread."""

CHUNK = 64
"""Members whose deviations are laid out by row before they are summed: long loops, few of them."""

LAG = 20
"""Measurements used between two counts of the lineage."""

MAX_POINTS = 2000
"""Most particles that `points` returns."""

OPTIONS = (
    Option("particles", 2000, 2, 1e7, "", "number of particles"),
    Option("fraction", 0.5, 0.0, 1.0, "", "resample when the effective sample size falls under this part of them"),
    Option.choice("resampling", SCHEME_NAMES, "how many children each particle gets"),
)


def members(options: Options) -> int:
    """Return the number of particles."""
    return int(options["particles"])


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """Return the numbers that the compiled functions read, in the order of `MEMBERS` and the following."""
    n = members(options)
    threads = n >= THREADED_FROM and threaded()
    fraction, scheme = options.get("fraction", 1.0), round(options["resampling"])
    return np.array([n, fraction, scheme, threads, 0.0, 0.0], float)


Cloud, cloud_at = declare_layout(
    "Cloud",
    "nx, n, record",
    head=f"{HEAD}",
    circular="nx",
    mean="nx",
    cov="nx, nx",
    log_w="n",
    lineage="n",
    records="n, record",
)
"""Head; mask of circular states; mean and covariance of the last posterior; log weights, whose exponentials sum to 1
after a measurement, to less if particles were lost since; origin of each particle; a record of each: the particle x
(nx,), and in some filters a covariance P (nx, nx) of its own."""


@layout
def cloud_in(at, size, nx, n):
    """Return the cloud in a state of `size` numbers; the records take all numbers that the other parts leave."""
    bare = cloud_at(at, nx, n, 0)
    return cloud_at(at, nx, n, (size - (bare.end - at) // WORD) // n)


@jit
def cloud_of(state, nx, n):
    """Return the cloud of n particles in a state."""
    return cloud_in(start_of(state), state.size, nx, n)


@jit
def count_of(context):
    """Return the number of particles."""
    return int(numbers(context)[MEMBERS])


@jit
def own_cloud(context, state):
    """Return the cloud in the state of a running filter."""
    return cloud_of(state, context.nx, count_of(context))


@jit
def own_covariance(record, nx):
    """Return the covariance (nx, nx) that stands behind a particle in its record."""
    return matrix(record, nx, nx, nx)


def sized(record: Callable[[int], int]) -> Callable[[Options, int], int]:
    """Return the `state_size` of a filter whose records hold `record(nx)` numbers."""
    return lambda options, nx: size_of(cloud_at, nx, members(options), record(nx))


def views(options: Options, state: np.ndarray, nx: int) -> Any:
    """Return the `Cloud` in a state as NumPy views."""
    parts = cloud_in(0, state.size, nx, members(options))
    return Cloud._make((*(view(part, state) for part in parts[:-1]), parts.end))


def weights_of(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights (N,), which sum to 1, and the records (N, record) of a state."""
    cloud = views(options, state, nx)
    w = np.exp(cloud.log_w - np.max(cloud.log_w))
    return w / np.sum(w), cloud.records


def block(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return a view of the records (N, record) in a state."""
    return np.asarray(views(options, state, nx).records)


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (nx,) and the covariance (nx, nx) of a state."""
    mean, cov = np.empty(nx), np.empty((nx, nx))
    cloud_moments(state, nx, members(options), mean, cov)
    return mean, cov


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return at most `MAX_POINTS` particles (k, nx): picked by weight at even steps, or all if weights are equal."""
    n = members(options)
    count = min(n, MAX_POINTS)
    if state[EQUAL]:
        return block(options, state, nx)[np.arange(count) * n // count, :nx]
    w, records = weights_of(options, state, nx)
    picked = np.searchsorted(np.cumsum(w), (np.arange(count) + 0.5) / count)
    return records[np.minimum(picked, n - 1), :nx]


def peaks(options: Options, state: np.ndarray, nx: int) -> list[Peak]:
    """Return the peaks of the cloud."""
    return peaks_of(points(options, state, nx), views(options, state, nx).circular != 0.0)


def recoveries(state: np.ndarray) -> int:
    """Return how often the cloud was widened or drawn again from the prior since the filter started."""
    return int(state[RECOVERIES])


def account(options: Options, state: np.ndarray, nx: int) -> dict[str, float | list[float]]:
    """Return the number of particles, effective and recovered ones, and of ancestors `lag` measurements ago."""
    return {
        "particles": float(members(options)),
        "effective": float(state[ESS]),
        "ancestors": float(state[ORIGINS]),
        "lag": float(LAG),
        "resampled": float(state[RESAMPLED]),
        "recovered": float(state[RECOVERIES]),
    }


SHARED: dict[str, Any] = {
    "family": "particle",
    "samples": True,
    "moments": moments,
    "points": points,
    "peaks": peaks,
    "recoveries": recoveries,
    "account": account,
    "options": OPTIONS,
    "tune": tune,
}
"""Fields of an `Estimator` that most particle filters share."""


@jit
def weigh_equally(context, state):
    """Give every particle the weight 1/N."""
    log_w = own_cloud(context, state).log_w
    log_w[:] = -np.log(log_w.size)
    state[EQUAL] = 1.0
    state[ESS] = log_w.size


@jit
def next_draw(state):
    """Count this prediction or update, and return the count, which keys its random numbers.

    The count is part of the state, so a rewind takes it back, sub-steps of one event (`max_step`) differ, and queries,
    which work on a copy, change no draw of the estimate.
    """
    state[DRAWS] += 1.0
    state[SETTLED] = 0.0
    return int(state[DRAWS])


@jit
def wrap_record(circular, x):
    """Wrap the circular states of a particle to ±π."""
    for j in range(circular.size):
        if circular[j] != 0 and not (-np.pi <= x[j] < np.pi):
            x[j] = wrap(x[j])


@jit
def begin_lineage(context, state):
    """Make every particle its own origin.

    Every `LAG` measurements each particle is given its own number, which its children inherit. The numbers left after
    `LAG` more count the particles of then that have descendants now. If there is one, every state that does not move by
    itself (a parameter, a slow state) has a single value in the whole cloud, and its spread is only noise since.
    """
    lineage = own_cloud(context, state).lineage
    for i in range(lineage.size):
        lineage[i] = i
    state[ORIGINS] = lineage.size
    state[GENERATIONS] = 0.0


@jit
def count_origins(context, state):
    """Count one more measurement used; every `LAG` of them, count the origins and begin anew."""
    state[GENERATIONS] += 1.0
    if state[GENERATIONS] < LAG:
        return
    lineage = own_cloud(context, state).lineage
    # Families lie side by side in the order of their ancestors, so an origin is where the number changes.
    origins = 1
    for i in range(1, lineage.size):
        if lineage[i] != lineage[i - 1]:
            origins += 1
    begin_lineage(context, state)
    state[ORIGINS] = origins


@jit
def score_cloud(state, score):
    """Write the effective sample size and the number of ancestors to the track's scores."""
    score[EFFECTIVE] = state[ESS]
    score[ANCESTORS] = state[ORIGINS]


@layout
def sums_size(nx, ny):
    """Return the length of the sums of states or measurements."""
    k = max(nx, ny)
    return 4 + k + k * k + 2 * ny


@jit
def tails_of(context, sums):
    """Return the tails of the predicted measurement in the sums: two per row."""
    return sums[sums.size - 2 * context.width :]


@jit
def clear_sums(sums):
    """Set the sums to zero and the largest log weight to -inf."""
    sums[:] = 0.0
    sums[2] = -np.inf


@jit
def add_chunk(D, n, m, sums):
    """Add n members to Σw, Σw², and from 4 on the m sums Σ w d and the lower triangle of Σ w d dᵀ.

    D (m + 2, CHUNK) holds the weights in row m and the deviations in the rows above; row m + 1 is scratch.
    """
    w, a = D[m], D[m + 1]
    sums[0] += total(n, w)
    sums[1] += dot(n, w, w)
    for i in range(m):
        sums[4 + i] += weighted(n, w, D[i], a)
        for j in range(i + 1):
            sums[4 + m + i * m + j] += dot(n, a, D[j])


@jit
def add_members(circular, w, records, reference, D, sums):
    """Add particles of weights `w`, and their own covariances if they have any, to the sums of the cloud's moments.

    `circular` (nx,) is the mask of the circular states; D (nx + 2, CHUNK) is scratch.
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
            if circular[j] != 0.0:
                for i in range(n):
                    d[i] = wrap(d[i])
        copied(n, w[first:], D[nx])
        add_chunk(D, n, nx, sums)
        if own:
            for k in range(n):
                record = records[first + k]
                for i in range(nx):
                    for j in range(i + 1):
                        sums[4 + nx + i * nx + j] += w[first + k] * record[nx + i * nx + j]


@jit
def finish_moments(circular, sums, reference, mean, cov):
    """Fill mean and covariance from the sums of deviations from a reference."""
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
        if circular[i] != 0.0:
            mean[i] = wrap(mean[i])


@jit
def cloud_moments(state, nx, n, mean, cov):
    """Fill weighted mean and covariance of the cloud, about its heaviest particle, so that angles do not tear.

    A circular state's mean is that of the deviations from the heaviest particle, wrapped: the intrinsic mean of any
    cloud that does not reach around the circle.
    """
    cloud = cloud_of(state, nx, n)
    if state[SETTLED] != 0.0:
        mean[:] = cloud.mean
        cov[:] = cloud.cov
        return
    log_w, records = cloud.log_w, cloud.records
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
            exp_minus(last - first, log_w[first:], top, w)
        add_members(cloud.circular, w[: last - first], records[first:last], reference, D, sums)
    finish_moments(cloud.circular, sums, reference, mean, cov)


@jit
def describe(context, state, mean, std, cross):
    """Fill mean, standard deviation and the configured covariances of the shown states."""
    n = context.nx
    x, cov = np.empty(n), np.empty((n, n))
    cloud_moments(state, n, count_of(context), x, cov)
    tell(context, x, cov, mean, std, cross)
