"""The state of a particle filter: a weighted cloud, laid out flat.

Sources: Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015; Arulampalam, Maskell, Gordon & Clapp (2002),
doi:10.1109/78.978374.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..estimator import Option, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit, matrix, threaded
from ..numerics.linalg import wrap
from ..numerics.workspace import WORD, layout, size_of, start_of, take_matrix, take_vector, view
from ..tuning import Tuning
from .resampling import SCHEME_NAMES

DRAWS, SETTLED, EQUAL, ESS, RECOVERIES, RESAMPLED, ORIGINS, GENERATIONS = range(8)
"""Head of the state: predictions and updates so far; whether mean and covariance are up to date;
whether all weights are equal; effective sample size; clouds that had to be recovered; clouds resampled; particles from
which the present ones descend, at the last count, and readings used since (lineage.py)."""

HEAD = 8

MEMBERS, FRACTION, SCHEME, THREADS, WIDTH, DUPLICATES = range(6)
"""Positions in the context's options; `WIDTH` is that of the kernel of `pf-reg`, 0 in all others, `DUPLICATES` whether
it moves only particles that have a sibling."""

PROCESS, START, RESAMPLE, JITTER, RECOVER, DRAW = range(6)
"""Streams of randomness; see numerics/random.py."""

THREADED_FROM = 16_384
"""Members from which threads gain more than they cost."""

OPTIONS = (
    Option("particles", 2000, 2, 1e7, "", "number of particles"),
    Option("fraction", 0.5, 0.0, 1.0, "", "resample when the effective sample size falls under this part of them"),
    Option.choice("resampling", SCHEME_NAMES, "how many children each particle gets"),
)


def members(options: Options) -> int:
    """Number of particles."""
    return int(options["particles"])


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The numbers that the compiled functions read, in the order of `MEMBERS` and the following."""
    n = members(options)
    threads = n >= THREADED_FROM and threaded()
    fraction, scheme = options.get("fraction", 1.0), round(options["resampling"])
    return np.array([n, fraction, scheme, threads, 0.0, 0.0], float)


class Cloud(NamedTuple):
    """The state: the head, which states are circular (nx,), the last posterior's mean (nx,) and cov (nx, nx).

    Then the log weights (N,), whose exponentials sum to 1 after a reading, to less if particles were lost since; the
    particles' origins (N,), see lineage.py; and N records (N, record): the particle x (nx,), and in some filters a
    covariance P (nx, nx) of its own.
    """

    head: Any
    circular: Any
    mean: Any
    cov: Any
    log_w: Any
    lineage: Any
    records: Any
    end: int


@layout
def cloud_at(at, nx, n, record):
    """Lay the state out for n particles of `record` numbers."""
    head, at = take_vector(at, HEAD)
    circular, at = take_vector(at, nx)
    mean, at = take_vector(at, nx)
    cov, at = take_matrix(at, nx, nx)
    log_w, at = take_vector(at, n)
    lineage, at = take_vector(at, n)
    records, at = take_matrix(at, n, record)
    return Cloud(head, circular, mean, cov, log_w, lineage, records, at)


@layout
def cloud_in(at, size, nx, n):
    """The cloud in a state of `size` numbers: what is left by the others is the records'."""
    bare = cloud_at(at, nx, n, 0)
    return cloud_at(at, nx, n, (size - (bare.end - at) // WORD) // n)


@jit
def cloud_of(state, nx, n):
    """The cloud of n particles in a state."""
    return cloud_in(start_of(state), state.size, nx, n)


def sized(record: Callable[[int], int]) -> Callable[[Options, int], int]:
    """`state_size` of a filter whose records hold `record(nx)` numbers."""
    return lambda options, nx: size_of(cloud_at, nx, members(options), record(nx))


def views(options: Options, state: np.ndarray, nx: int) -> Cloud:
    """The cloud in a state, as NumPy's views."""
    parts = cloud_in(0, state.size, nx, members(options))
    return Cloud._make((*(view(part, state) for part in parts[:-1]), parts.end))


def weights_of(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights (N,), which sum to 1, and records (N, record) of a state."""
    cloud = views(options, state, nx)
    w = np.exp(cloud.log_w - np.max(cloud.log_w))
    return w / np.sum(w), cloud.records


def block(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """A view of the records (N, record) in a state."""
    return np.asarray(views(options, state, nx).records)


@jit
def own_covariance(record, nx):
    """The covariance (nx, nx) that stands behind a particle in its record."""
    return matrix(record, nx, nx, nx)


@jit
def weigh_equally(state, nx, n):
    """Give every particle the weight 1/N."""
    log_w = cloud_of(state, nx, n).log_w
    equal = -np.log(n)
    for i in range(n):
        log_w[i] = equal
    state[EQUAL] = 1.0
    state[ESS] = n


@jit
def next_draw(state):
    """Number this prediction or update among all of the state's, and return the number: the place of its draws.

    The count is part of the state, so a rewind takes it back, sub-steps of one event (`max_step`) differ, and queries,
    which work on a copy, change no draw of the estimate.
    """
    state[DRAWS] += 1.0
    state[SETTLED] = 0.0
    return int(state[DRAWS])


@jit
def wrap_record(circular, x):
    """Bring the circular states of a particle back to ±π."""
    for j in range(circular.size):
        if circular[j] != 0 and not (-np.pi <= x[j] < np.pi):
            x[j] = wrap(x[j])
