"""What the Rao-Blackwellised filter works in.

A record is x (nx,) and P (nx, nx): the sampled states and the mode as values, the mean of the linear states in their
places of x, their covariance in their rows of P; the other rows are zero. So F P Fᵀ + Q is the covariance of the whole
next state given what the particle has sampled so far, and P adds to the cloud's covariance as it is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled.context import options as numbers
from ..compiled.jacobians import scratch_size
from ..estimator import Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit, threaded
from ..numerics.workspace import layout, size_of, take_matrix, take_vector
from ..tuning import Tuning
from .cloud import MEMBERS, THREADS, members
from .cloud import tune as tune_cloud
from .moments import BLOCK
from .steps import blocks_of, work_at
from .weights import OWN

PREDICT, CONDITION, ADOPT = range(OWN, OWN + 3)
"""Phases: one step on; each particle's own posterior and density of the reading, aside; that posterior made its own."""

THREADED_FROM = 4 * BLOCK
"""Particles from which threads gain more than they cost: fewer than of `pf`, since each takes ten times as long."""


class Room(NamedTuple):
    """What a block's particles are worked on in, one after the other.

    F, T, C and Q (nx, nx), the next state, a column and the variances before draws (nx,); H (ny, nx), B = P Hᵀ (nx,
    ny), S and its factor U (ny, ny), e and ŷ (ny,); what a Jacobian takes.
    """

    F: Any
    T: Any
    C: Any
    Q: Any
    forward: Any
    column: Any
    before: Any
    H: Any
    B: Any
    S: Any
    U: Any
    e: Any
    expected: Any
    scratch: Any
    end: int


@layout
def room_at(at, nx, ny):
    """Lay it out."""
    F, at = take_matrix(at, nx, nx)
    T, at = take_matrix(at, nx, nx)
    C, at = take_matrix(at, nx, nx)
    Q, at = take_matrix(at, nx, nx)
    forward, at = take_vector(at, nx)
    column, at = take_vector(at, nx)
    before, at = take_vector(at, nx)
    H, at = take_matrix(at, ny, nx)
    B, at = take_matrix(at, nx, ny)
    S, at = take_matrix(at, ny, ny)
    U, at = take_matrix(at, ny, ny)
    e, at = take_vector(at, ny)
    expected, at = take_vector(at, ny)
    scratch, at = take_vector(at, scratch_size(nx, ny))
    return Room(F, T, C, Q, forward, column, before, H, B, S, U, e, expected, scratch, at)


class Aside(NamedTuple):
    """What follows the cloud's scratch: the particles' own posteriors (N, nx + nx²), and where the rooms begin."""

    posteriors: Any
    rooms: int
    end: int


@layout
def aside_at(at, nx, ny, n):
    """Lay it out."""
    posteriors, at = take_matrix(at, n, nx + nx * nx)
    return Aside(posteriors, at, at + blocks_of(n) * room_at(0, nx, ny).end)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the cloud's, the particles' own posteriors, and a room for each block."""
    n = members(options)
    return size_of(work_at, nx, ny, n) + size_of(aside_at, nx, ny, n)


@jit
def aside_of(context, shared):
    """What follows the cloud's scratch."""
    return aside_at(shared.end, context.nx, context.width, int(numbers(context)[MEMBERS]))


@jit
def room_of(context, shared, b):
    """The room of block b."""
    nx, ny = context.nx, context.width
    return room_at(aside_of(context, shared).rooms + b * room_at(0, nx, ny).end, nx, ny)


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The cloud's numbers, with threads from fewer particles on."""
    values = tune_cloud(options, model, tuning)
    values[THREADS] = members(options) >= THREADED_FROM and threaded()
    return values
