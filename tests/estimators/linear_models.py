"""Random linear models for the tests, with all their matrices in the parameters, so that Numba compiles them once.

    x' = x + dt (A x + B u) + w,  w ~ N(0, q₀ dt W),      y_k = H_k x + D_k u + v,  v ~ N(0, R_k)

Parameters p: nx, nu, then A, B, W, then for each of three sensors H_k, D_k. A sensor's size is that of `out`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from estimators.log import INPUT, READING, Events, Log
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from tests.support import SECOND, as_log

ROWS = (1, 2, 3)
"""Rows of the three sensors."""


def f(x, u, p, dt, out):
    n = x.size
    m = u.size
    for i in range(n):
        s = x[i]
        for j in range(n):
            s += dt * p[i * n + j] * x[j]
        for j in range(m):
            s += dt * p[n * n + i * m + j] * u[j]
        out[i] = s


def Q(x, u, p, q, dt, out):
    n = x.size
    at = n * n + n * u.size
    for i in range(n):
        for j in range(n):
            out[i, j] = q[0] * dt * p[at + i * n + j]


def reads(x, u, p, out):
    """h of the sensor with as many rows as `out` has; those of fewer rows stand before it in p."""
    n, m, rows = x.size, u.size, out.size
    at = 2 * n * n + n * m + rows * (rows - 1) // 2 * (n + m)
    for i in range(rows):
        s = 0.0 * x[0]
        for j in range(n):
            s += p[at + i * (n + m) + j] * x[j]
        for j in range(m):
            s += p[at + i * (n + m) + n + j] * u[j]
        out[i] = s


@dataclass(frozen=True)
class Matrices:
    """A random linear model as matrices, and the model that says the same."""

    A: np.ndarray
    B: np.ndarray
    W: np.ndarray
    H: tuple[np.ndarray, ...]
    D: tuple[np.ndarray, ...]
    R: tuple[np.ndarray, ...]
    mean: np.ndarray
    std: np.ndarray
    q: float
    u: np.ndarray
    model: StateSpaceModel
    C: tuple[np.ndarray, ...]


def random_linear(
    rng: np.random.Generator, nx: int, nu: int, *, correlated: bool = False, certain: bool = False
) -> Matrices:
    """`correlated`: the rows of each sensor are; `certain`: a state is known at first, a row read without noise."""
    A = rng.normal(0, 0.3, (nx, nx)) - 0.2 * np.eye(nx)
    B = rng.normal(0, 1, (nx, nu))
    root = rng.normal(0, 1, (nx, nx))
    W = root @ root.T / nx + 0.1 * np.eye(nx)
    H = tuple(rng.normal(0, 1, (m, nx)) for m in ROWS)
    D = tuple(rng.normal(0, 1, (m, nu)) for m in ROWS)
    R = tuple(rng.uniform(0.2, 2.0, m) for m in ROWS)
    mean, std, u = rng.normal(0, 2, nx), rng.uniform(0.5, 2.0, nx), rng.normal(0, 1, nu)
    C = tuple(random_correlation(rng, m) if correlated else np.eye(m) for m in ROWS)
    if certain:
        std[0] = R[2][1] = 0.0
    numbers = [A, B, W, *(np.hstack(pair) for pair in zip(H, D, strict=True))]
    p = np.concatenate([block.ravel() for block in numbers])
    model = StateSpaceModel(
        name="linear",
        title="random linear model",
        states=tuple(State(f"x{i}", "m", mean=mean[i], std=std[i]) for i in range(nx)),
        inputs=tuple(Input(f"u{i}", "m", default=u[i]) for i in range(nu)),
        parameters=tuple(Parameter(f"p{i}", "1", value) for i, value in enumerate(p)),
        noises=(Noise("all", "m²/s", variance=0.3),),
        sensors=tuple(
            Sensor(
                name,
                tuple(Row(f"r{j}", "m", variance=r) for j, r in enumerate(variances)),
                h=reads,
                correlation=c if correlated else None,
            )
            for name, variances, c in zip(("first", "second", "third"), R, C, strict=True)
        ),
        f=f,
        Q=Q,
        linear=True,
    )
    return Matrices(A, B, W, H, D, R, mean, std, 0.3, u, model, C)


def random_correlation(rng: np.random.Generator, m: int) -> np.ndarray:
    """A correlation matrix (m, m), its entries of all sizes."""
    root = rng.normal(0, 1, (m, m))
    c = root @ root.T + 0.1 * np.eye(m)
    c /= np.sqrt(np.outer(np.diag(c), np.diag(c)))
    return 0.5 * (c + c.T) - np.diag(np.diag(c)) + np.eye(m)


def random_log(rng: np.random.Generator, matrices: Matrices, events: int, *, missing: float = 0.2) -> Log:
    """Events of three sensors at rates 3:2:1 and irregular times (some equal), inputs now and then, lost rows."""
    width = matrices.model.width
    nu = matrices.u.size
    t, batch = 5 * SECOND, []
    for _ in range(events):
        t += int(rng.choice([0, 10**7, 10**8, 3 * 10**8]) * rng.uniform(0.5, 1.5))
        if nu and rng.random() < 0.15:
            values = np.where(rng.random(nu) < 0.3, np.nan, rng.normal(0, 1, nu))
            batch.append(Events.one(t, t, INPUT, 0, values, width))
            continue
        sensor = int(rng.choice(3, p=[0.5, 0.33, 0.17]))
        y = rng.normal(0, 2, ROWS[sensor])
        y[rng.random(y.size) < missing] = np.nan
        batch.append(Events.one(t, t, READING, sensor, y, width))
    return as_log(Events.concat(batch, width))


class JointGaussian:
    """All states of a linear model at all events, and all readings, as ONE Gaussian; no recursion over time.

    The states stacked, X = (x_0 … x_K), obey M X = c + e with M block bidiagonal (identity, and -F below), e block
    diagonal with the prior and the process noises. So X ~ N(M⁻¹ c, M⁻¹ E M⁻ᵀ); the readings are Y = H X + d + v.
    """

    def __init__(self, matrices: Matrices, log: Log) -> None:
        events = log.events
        n, K = matrices.mean.size, len(events)
        M = np.eye(n * K)
        c = np.zeros(n * K)
        E = np.zeros((n * K, n * K))
        u = matrices.u.copy()
        rows, offsets, values, places, self.owner = [], [], [], [], []
        for k in range(K):
            here = slice(n * k, n * (k + 1))
            if k == 0:
                c[here], E[here, here] = matrices.mean, np.diag(matrices.std**2)
            else:
                dt = (int(events.t[k]) - int(events.t[k - 1])) / SECOND
                M[here, n * (k - 1) : n * k] = -(np.eye(n) + dt * matrices.A)
                c[here] = dt * matrices.B @ u
                E[here, here] = matrices.q * dt * matrices.W
            if events.kind[k] == INPUT:
                given = events.value[k, : u.size]
                u = np.where(np.isfinite(given), given, u)
            if events.kind[k] == READING:
                sensor = events.channel[k]
                for row in range(ROWS[sensor]):
                    if np.isfinite(events.value[k, row]):
                        line = np.zeros(n * K)
                        line[here] = matrices.H[sensor][row]
                        rows.append(line)
                        offsets.append(matrices.D[sensor][row] @ u)
                        values.append(events.value[k, row])
                        places.append((sensor, row))
                        self.owner.append(k)
        inverse = np.linalg.inv(M)
        self.n, self.owner = n, np.array(self.owner)
        self.mean, self.cov = inverse @ c, inverse @ E @ inverse.T
        self.H, self.offset, self.y, self.R = (
            np.array(rows),
            np.array(offsets),
            np.array(values),
            np.zeros((len(values),) * 2),
        )
        for i, (sensor, row) in enumerate(places):
            for j, (_, other) in enumerate(places):
                if self.owner[i] == self.owner[j]:
                    r = matrices.R[sensor]
                    self.R[i, j] = r[row] if i == j else matrices.C[sensor][row, other] * np.sqrt(r[row] * r[other])
        self.channel = events.channel[self.owner]
        self.events = np.unique(self.owner)
        self._kept: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def _given(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of all states given the rows of a mask, in one solve."""
        key = mask.tobytes()
        if key not in self._kept:
            H = self.H[mask]
            S = H @ self.cov @ H.T + self.R[np.ix_(mask, mask)]
            gain = np.linalg.solve(S, H @ self.cov).T
            mean = self.mean + gain @ (self.y[mask] - self.offset[mask] - H @ self.mean)
            self._kept[key] = mean, self.cov - gain @ S @ gain.T
        return self._kept[key]

    def filtered(self, k: int, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of x_k given the readings up to event k of the sensors in use."""
        mean, cov = self._given((self.owner <= k) & used[self.channel])
        here = slice(self.n * k, self.n * (k + 1))
        return mean[here], cov[here, here]

    def smoothed(self, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (K, n) and covariance (K, n, n) of every x_k given all readings of the sensors in use."""
        mean, cov = self._given(used[self.channel])
        n = self.n
        blocks = np.array([cov[i : i + n, i : i + n] for i in range(0, mean.size, n)])
        return mean.reshape(-1, n), blocks

    def predictive(self, k: int, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Innovation of event k and its covariance, given the readings before it of the sensors in use."""
        mean, cov = self._given((self.owner < k) & used[self.channel])
        mask = self.owner == k
        H = self.H[mask]
        return self.y[mask] - self.offset[mask] - H @ mean, H @ cov @ H.T + self.R[np.ix_(mask, mask)]

    def log_likelihood(self, used: np.ndarray) -> float:
        """log p(all readings of the sensors in use), from the joint density."""
        mask = used[self.channel]
        H = self.H[mask]
        S = H @ self.cov @ H.T + self.R[np.ix_(mask, mask)]
        nu = self.y[mask] - self.offset[mask] - H @ self.mean
        _, log_det = np.linalg.slogdet(S)
        return float(-0.5 * (nu @ np.linalg.solve(S, nu) + log_det + nu.size * np.log(2 * np.pi)))


CORRELATED = 2
"""The seed of a case whose sensors' rows are correlated."""


@cache
def case(nx: int, nu: int, seed: int) -> tuple[Matrices, Log, JointGaussian]:
    """A random linear model, a log of it, and both as one Gaussian."""
    rng = np.random.default_rng([nx, nu, seed])
    matrices = random_linear(rng, nx, nu, correlated=seed == CORRELATED)
    log = random_log(rng, matrices, events=40)
    return matrices, log, JointGaussian(matrices, log)


def assert_mean(runs: Sequence[Any], exact: Any, bias: Any = 0.0) -> None:
    """The mean of what runs found is right to five of its own standard errors, but for a bias."""
    error = np.std(runs, axis=0, ddof=1) / np.sqrt(len(runs))
    assert np.all(np.abs(np.mean(runs, axis=0) - exact) < 5 * error + bias)


def close(actual: np.ndarray, expected: np.ndarray, what: str, tolerance: float = 1e-9) -> None:
    """Equal but for a share of the largest entry."""
    scale = max(1e-3, float(np.max(np.abs(expected))))
    error = float(np.max(np.abs(np.asarray(actual) - expected))) / scale
    assert error < tolerance, f"{what}: off by {error:.1e} of {scale:.3g}"


def kalman(mean, P, H, offset, R, y):
    """Mean, covariance, NIS, log-likelihood and √diag S of N(mean, P) given a reading y = H x + offset + N(0, R)."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    nu = y - H @ mean - offset
    nis = nu @ np.linalg.solve(S, nu)
    log_likelihood = -0.5 * (nis + np.linalg.slogdet(S)[1] + nu.size * np.log(2 * np.pi))
    return mean + K @ nu, P - K @ S @ K.T, nis, log_likelihood, np.sqrt(np.diag(S))
