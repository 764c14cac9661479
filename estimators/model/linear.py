"""Linear models from matrices, for steps of any length.

    dx/dt = A x + B u + w,   w white with E[w wᵀ] = diag(q);        y = C x + D u + v

With u held over a step, x' = Φ x + Γ u + w', where

    exp([[A, B], [0, 0]] dt) = [[Φ, Γ], [0, I]],        Q(dt) = ∫₀^dt exp(A s) diag(q) exp(Aᵀ s) ds

A model of sample time T with x⁺ = A x + B u is first brought to continuous time by the matrix logarithm, which gives
the same states at whole multiples of T and the zero-order hold between them; without a real logarithm it is refused.

Both Φ and Q are Taylor series of dt / 2^s, doubled s times: Φ(2h) = Φ(h)², Q(2h) = Φ(h) Q(h) Φ(h)ᵀ + Q(h). Unlike
the exponential of Van Loan's block matrix, no e^(-A dt) overflows if A has fast decaying modes.

Sources: Van Loan (1978), Computing integrals involving the matrix exponential, doi:10.1109/TAC.1978.1101743, for Φ, Γ
and Q; Higham (2008), Functions of Matrices, doi:10.1137/1.9780898717778, sections 10.3 (scaling and squaring) and
11.2 (the principal logarithm).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import isfinite

import numpy as np

from ..errors import ModelError
from .parts import Row, Sensor, State
from .state_space import Input, Noise, StateSpaceModel, squared

MAX_ORDER = 200
"""States and inputs up to which a model from matrices is taken: each step costs some 30 products of matrices."""

TERMS = 18  # Terms of the Taylor series: 0.5^19 / 19! is below the rounding of 1

Rows = tuple[tuple[float, ...], ...]
"""A matrix by rows, which a cached function can take."""


def linear_model(
    name: str,
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray,
    D: np.ndarray,
    *,
    states: Sequence[State],
    inputs: Sequence[Input] = (),
    sensors: Sequence[tuple[str, Sequence[Row]]],
    variances: Sequence[float] | None = None,
    sample_time: float = 0.0,
    title: str = "",
) -> StateSpaceModel:
    """Return the model with these matrices; it takes steps of any length.

    Args:
        name: Name of the model.
        A: Dynamics, shape (nx, nx).
        B: Effect of the inputs, shape (nx, nu).
        C: Measurements, shape (ny, nx): the rows of all sensors in their order.
        D: Direct effect of the inputs on the measurements, shape (ny, nu).
        states: The states, nx.
        inputs: The inputs, nu.
        sensors: Name and rows of each sensor.
        variances: Variance that white noise adds to each state in one second, (nx,). Default: 0.
        sample_time: Seconds of a step x⁺ = A x + B u; 0 for a continuous model.
        title: Title of the model. Default: its name.

    Raises:
        ModelError: If a matrix is of another shape or has entries that are not finite, or if a discrete model has no
            real logarithm.
    """
    nx, nu, ny = len(states), len(inputs), sum(len(rows) for _, rows in sensors)
    shapes = {"A": (nx, nx), "B": (nx, nu), "C": (ny, nx), "D": (ny, nu)}
    A, B, C, D = (np.asarray(matrix, float) for matrix in (A, B, C, D))
    for (letter, shape), matrix in zip(shapes.items(), (A, B, C, D), strict=True):
        if np.shape(matrix) != shape:
            raise ModelError(
                f"model {name}: {letter} has shape {np.shape(matrix)}; {nx} states, {nu} inputs and {ny} rows of "
                f"sensors need {shape}"
            )
        if not np.all(np.isfinite(matrix)):
            raise ModelError(f"model {name}: {letter} has entries that are not finite; all must be")
    if nx + nu > MAX_ORDER:
        raise ModelError(f"model {name} has {nx + nu} states and inputs; matrices may have {MAX_ORDER} at most")
    if not (sample_time >= 0.0 and isfinite(sample_time)):
        raise ModelError(f"model {name}: the sample time is {sample_time:g} s; it must be zero or positive")
    M = np.zeros((nx + nu, nx + nu))
    M[:nx, :nx], M[:nx, nx:] = A, B
    if sample_time > 0.0:
        M = _continuous(name, M, nx, sample_time)
    q = np.zeros(nx) if variances is None else variances
    whole, made, first = _rows(M), [], 0
    for sensor, rows in sensors:
        own = slice(first, first + len(rows))
        h, H = _measurement(_rows(np.hstack((C[own], D[own]))))
        made.append(Sensor(sensor, tuple(rows), h=h, H=H))
        first = own.stop
    return StateSpaceModel(
        name=name,
        title=title or name,
        states=tuple(states),
        inputs=tuple(inputs),
        noises=tuple(
            Noise(state.name, f"{squared(state.unit)}/s", float(value)) for state, value in zip(states, q, strict=True)
        ),
        sensors=tuple(made),
        f=_step(whole),
        F=_slope(whole),
        Q=_noise(whole, nx),
        linear=True,
    )


def _rows(matrix: np.ndarray) -> Rows:
    return tuple(tuple(float(c) for c in row) for row in matrix)


def _continuous(name: str, M: np.ndarray, nx: int, sample_time: float) -> np.ndarray:
    """Return [[A, B], [0, 0]] of the continuous model whose step over the sample time is [[A, B], [0, I]]."""
    from scipy.linalg import expm, logm

    step = M.copy()
    step[nx:, nx:] = np.eye(len(M) - nx)
    for value in np.linalg.eigvals(step[:nx, :nx]):
        if value.real <= 0.0 and abs(value.imag) <= 1e-12 * max(1.0, abs(value)):
            kind = "a delay" if abs(value) <= 1e-12 else "a mode that changes its sign at each sample"
            raise ModelError(
                f"model {name}: A has the eigenvalue {value.real:.3g}, {kind}, which no continuous model has, so that "
                f"measurements between its samples of {sample_time:g} s have no prediction; remove that mode or give "
                "a continuous model"
            )
    log = np.asarray(logm(step))
    error = float(np.abs(expm(log) - step).max()) if np.all(np.isfinite(log)) else np.inf
    if not error <= 1e-9 * float(np.abs(step).max()) or float(np.abs(log.imag).max()) > 1e-9 * float(np.abs(log).max()):
        raise ModelError(
            f"model {name}: A and B have no accurate real logarithm (error {error:.2g}), so that the discrete model "
            "has no continuous form; give a continuous model"
        )
    M = log.real / sample_time
    M[nx:] = 0.0
    return M


def doublings(M, dt):
    """Return how often dt is halved until the largest row sum of M dt is at most 1/2."""
    norm = 0.0
    for i in range(M.shape[0]):
        row = 0.0
        for j in range(M.shape[1]):
            row += abs(M[i, j])
        norm = max(norm, row)
    norm *= abs(dt)
    count = 0
    while norm > 0.5 and count < 100:
        norm *= 0.5
        count += 1
    return count


def product(A, B, out):
    """Fill out = A B."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
        for k in range(A.shape[1]):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    out[i, j] += a * B[k, j]


def growth(M, dt, out):
    """Fill out = exp(M dt) - I, which keeps the digits of slow modes beside fast ones while it is doubled."""
    count = doublings(M, dt)
    h = dt / 2.0**count
    n = M.shape[0]
    term, other = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            term[i, j] = M[i, j] * h
            out[i, j] = term[i, j]
    for k in range(2, TERMS + 1):
        product(M, term, other)
        for i in range(n):
            for j in range(n):
                term[i, j] = other[i, j] * h / k
                out[i, j] += term[i, j]
    for _ in range(count):
        double_growth(out, other)


def double_growth(G, other):
    """Fill G = (I + G)² - I, with scratch of its shape."""
    product(G, G, other)
    for i in range(G.shape[0]):
        for j in range(G.shape[0]):
            G[i, j] = 2.0 * G[i, j] + other[i, j]


def exponential(M, dt, out):
    """Fill out = exp(M dt)."""
    growth(M, dt, out)
    for i in range(M.shape[0]):
        out[i, i] += 1.0


def integral(A, q, dt, out):
    """Fill out = ∫₀^dt exp(A s) diag(q) exp(Aᵀ s) ds.

    Its Taylor series has the terms h^k / k! L^(k-1)(diag q) with L(X) = A X + X Aᵀ.
    """
    count = doublings(A, 2.0 * dt)
    h = dt / 2.0**count
    n = A.shape[0]
    G, term, other = np.empty((n, n)), np.zeros((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
        term[i, i] = q[i] * h
        out[i, i] = term[i, i]
    for k in range(2, TERMS + 2):
        product(A, term, other)
        for i in range(n):
            for j in range(i + 1):
                term[i, j] = (other[i, j] + other[j, i]) * h / k
                out[i, j] += term[i, j]
        for i in range(n):
            for j in range(i):
                term[j, i] = term[i, j]
                out[j, i] = out[i, j]
    growth(A, h, G)
    for _ in range(count):
        # F Q Fᵀ + Q with F = I + G
        product(G, out, other)
        for i in range(n):
            for j in range(n):
                other[i, j] += out[i, j]
        for i in range(n):
            for j in range(i + 1):
                s = other[i, j]
                for k in range(n):
                    s += other[i, k] * G[j, k]
                term[i, j] = s
        for i in range(n):
            for j in range(i + 1):
                out[i, j] += term[i, j]
                out[j, i] = out[i, j]
        double_growth(G, other)


def weigh(M, x, u, out):
    """Fill out = M [x, u], for as many rows as out has."""
    for i in range(out.size):
        s = M[i, 0] * x[0]
        for j in range(1, x.size):
            s += M[i, j] * x[j]
        for j in range(u.size):
            s += M[i, x.size + j] * u[j]
        out[i] = s


def lead(M, out):
    """Fill out with the leading rows and columns of M."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = M[i, j]


@lru_cache(maxsize=64)
def _step(whole: Rows):  # noqa: ANN202
    M = np.array(whole)

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        E = np.empty(M.shape)
        exponential(M, dt, E)
        weigh(E, x, u, out)

    return f


@lru_cache(maxsize=64)
def _slope(whole: Rows):  # noqa: ANN202
    M = np.array(whole)

    def F(x, u, p, dt, out):  # noqa: ANN001, ANN202
        E = np.empty(M.shape)
        exponential(M, dt, E)
        lead(E, out)

    return F


@lru_cache(maxsize=64)
def _noise(whole: Rows, nx: int):  # noqa: ANN202
    A = np.array(whole)[:nx, :nx].copy()

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        integral(A, q, dt, out)

    return Q


@lru_cache(maxsize=1024)
def _measurement(rows: Rows):  # noqa: ANN202
    M = np.array(rows)

    def h(x, u, p, out):  # noqa: ANN001, ANN202
        weigh(M, x, u, out)

    def H(x, u, p, out):  # noqa: ANN001, ANN202
        lead(M, out)

    return h, H
