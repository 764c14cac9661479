"""What the ensemble filters share: members as a flat state, where they start, what the track shows of them.

The state is the ensemble X (N, nx), member after member, the number of times that something was drawn, and in which
tenth of the members' expectations the readings lay. The covariance P = Aᵀ A / (N - 1) of its anomalies A is never
formed.

Members of a circular state keep within half a turn of their mean, which keeps within ±π; plain sums are then right.

Randomness goes by (seed, event, member), and sums over members run in their order: the same bits on any number of
threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled.context import (
    circular_states,
    shaped,
    shown_states,
)
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, belief_root
from ..estimator import Option, Options
from ..model.state_space import LARGE, StateSpaceModel
from ..numerics.jit import ints, jit
from ..numerics.linalg import wrap
from ..numerics.random import key_of, normal
from ..numerics.vectors import add_scaled
from ..numerics.workspace import layout, size_of, start_of, take_matrix, take_vector, view
from ..tuning import Tuning
from .localisation import crews

SIZE, INFLATION, ADDITIVE, CREWS, OWN = range(5)
"""Positions in the context's options; a filter's own number stands at the last."""

PROCESS, START, PERTURB, SPREAD, ROTATE, RANK = range(6)
"""Streams of randomness; see numerics/random.py."""

BINS = 10
"""Bins of the rank histogram (ranks.py)."""

THREADED_FROM = 65_536
"""Numbers in an ensemble from which threads gain more than they cost."""

MEMBERS = Option("members", 50, 2, 10_000, "", "number of members")
INFLATE = Option("inflation", 1.0, 1.0, 10.0, "", "factor on the anomalies after each reading that is used")
ADD = Option("additive", 0.0, 0.0, 10.0, "", "noise added after each reading, in standard deviations of the prior")
RADIUS = Option("radius", 0.0, 0.0, 1e9, "", "distance at which a reading's influence ends; 0: it has no end")


def members(options: Options) -> int:
    """Number of members."""
    return int(options["members"])


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The numbers that the compiled functions read."""
    N, own = members(options), options.get("rotation", 0.0)
    return np.array([N, options["inflation"], options["additive"], crews(N * model.nx, THREADED_FROM), own])


class Members(NamedTuple):
    """The state: members X (N, nx), how many predictions and analyses have drawn, (1,), and counts of ranks (BINS,)."""

    X: Any
    draws: Any
    ranks: Any
    end: int


@layout
def members_at(at, N, nx):
    """Lay the state out."""
    X, at = take_matrix(at, N, nx)
    draws, at = take_vector(at, 1)
    ranks, at = take_vector(at, BINS)
    return Members(X, draws, ranks, at)


def state_size(options: Options, nx: int) -> int:
    """Numbers in the state."""
    return size_of(members_at, members(options), nx)


def block(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """A view of the members (N, nx) in a state."""
    return view(members_at(0, members(options), nx).X, state)


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (nx,) and covariance (nx, nx) of a state; beyond `LARGE` states the variances (1, nx)."""
    X = block(options, state, nx)
    N = len(X)
    mean = X[0] + np.mean(X - X[0], axis=0) if nx <= LARGE else X.mean(axis=0)
    if nx <= LARGE:
        A = X - mean
        return mean, A.T @ A / (N - 1)
    variances = np.zeros((1, nx))
    for member in X:
        variances[0] += (member - mean) ** 2
    return mean, variances / (N - 1)


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """The members (N, nx); none of a large state."""
    return block(options, state, nx).copy() if nx <= LARGE else np.zeros((0, nx))


@jit
def parts(context, state):
    """The parts of a state."""
    return members_at(start_of(state), int(numbers(context)[SIZE]), context.nx)


@jit
def ensemble(context, state):
    """The members X (N, nx) of a state."""
    return parts(context, state).X


@jit
def settle(context, X):
    """Bring the circular states of the members within half a turn of their mean, and that within ±π."""
    circular = circular_states(context)
    N = X.shape[0]
    for j in range(circular.size):
        if circular[j] != 0:
            first = X[0, j]
            total = 0.0
            for i in range(N):
                X[i, j] = wrap(X[i, j] - first)
                total += X[i, j]
            shift = wrap(first + total / N) - total / N
            for i in range(N):
                X[i, j] += shift


@jit
def start(context, mean, cov, state):
    """Draw the members from N(mean, cov), cov (nx, nx) or, diagonal, (1, nx); their mean is then made exact."""
    X, draws, ranks, _ = parts(context, state)
    N, n = X.shape
    draws[0] = 0.0
    for k in range(BINS):
        ranks[k] = 0.0
    key = key_of(context.seed, 0, START)
    z = np.empty(n)
    total = np.zeros(n)
    diagonal = cov.shape[0] < n
    side = 1 if diagonal else n
    L = np.empty((side, side))
    if not diagonal:
        belief_root(cov, L)
    for i in range(N):
        for j in range(n):
            z[j] = normal(key, np.uint64(i * n + j))
            X[i, j] = 0.0
        if diagonal:
            if context.shape != 0:
                shaped(context, z, X[i])
            else:
                add_scaled(n, 1.0, z, X[i])
            for j in range(n):
                X[i, j] *= np.sqrt(cov[0, j])
        else:
            add_noise(L, z, X[i])
        add_scaled(n, 1.0 / N, X[i], total)
    for i in range(N):
        for j in range(n):
            X[i, j] += mean[j] - total[j]
    settle(context, X)


@jit
def describe(context, state, mean, std, cross):
    """Mean and standard deviation of the states that the track keeps, and the configured covariances."""
    X = ensemble(context, state)
    shown = shown_states(context)
    for k in range(mean.size):
        j = shown[k]
        mean[k] = column_mean(X, j)
        std[k] = np.sqrt(covariance(X, j, mean[k], j, mean[k]))
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for k in range(cross.size):
        i, j = pairs[2 * k], pairs[2 * k + 1]
        cross[k] = covariance(X, i, column_mean(X, i), j, column_mean(X, j))


@jit
def column_mean(X, j):
    """Mean of a state over the members."""
    N = X.shape[0]
    total = 0.0
    for i in range(N):
        total += X[i, j] - X[0, j]
    return X[0, j] + total / N


@jit
def covariance(X, j, mean_j, k, mean_k):
    """Covariance of two states over the members."""
    N = X.shape[0]
    total = 0.0
    for i in range(N):
        total += (X[i, j] - mean_j) * (X[i, k] - mean_k)
    return total / (N - 1)


@jit
def next_draw(context, state):
    """Number this prediction or analysis among all of the state's: the place of its draws; see estimator.py."""
    draws = parts(context, state).draws
    draws[0] += 1.0
    return int(draws[0])
