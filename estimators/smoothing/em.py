"""Q and R by expectation and maximisation: the noise that smoothed states and measurements show, iterated.

With w = x' - f(x) of each step between events and all moments those of the smoothed states,

    E[w wᵀ] = d dᵀ + P' - F L - Lᵀ Fᵀ + F P Fᵀ,    d = x' - f(x),  L = Cov(x, x')
    qⱼ ← qⱼ Σ tr(Q⁻¹ Sⱼ Q⁻¹ E[w wᵀ]) / Σ tr(Q⁻¹ Sⱼ),    Q = Σ qⱼ Sⱼ
    r ← mean of (y - h(x))² + H P Hᵀ

For a linear model whose Sⱼ do not overlap (Sⱼ Q⁻¹ Sₖ = 0) each round raises the likelihood of the measurements until it
reaches a maximum; with Sⱼ that do, the maximum is a fixed point, but a round may lower the likelihood. Convergence is
slow where one noise masks another, so each pair of rounds is extrapolated. EM reaches the same maximum likelihood
estimate as a direct search.

Sources: Shumway & Stoffer (1982), doi:10.1111/j.1467-9892.1982.tb00349.x; Särkkä, Bayesian Filtering and Smoothing
(2013), 12.3.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..compiled.context import (
    add_process_noise,
    circular_rows,
    circular_states,
    expect,
    process_variances,
    sensor_rows,
    steps_of,
    transition,
)
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..errors import EstimatorError
from ..fold import Fold
from ..log import INPUT, READING, RESET, Log
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit
from ..numerics.linalg import copy_vector, root, wrap
from ..track import USED, covariances
from ..tuning import Tuning
from .moments_back import MomentsBack
from .notes import solve_semidefinite
from .smooth import check_smooth
from .walk import Smoothed, Walk

MAX_EXTRAPOLATION = 5.0  # Largest extrapolation of the logarithm of a variance


class EmFit(NamedTuple):
    """The fitted tuning; the log-likelihood at the start and after each pair of rounds; whether it has converged.

    change: largest relative change of a variance in the last round.
    """

    tuning: Tuning
    log_likelihood: np.ndarray
    converged: bool
    change: float


def em(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    *,
    noises: tuple[str, ...] | None = None,
    rounds: int = 200,
    tolerance: float = 1e-5,
) -> EmFit:
    """Fit the process noises and the variances of the sensors' rows to a log.

    Args:
        estimator: A Gaussian filter that can be smoothed.
        model: The model; its Q must be linear in the noises.
        tuning: Start of the iteration. A noise or a variance of zero stays zero; so does one of a sensor that is not
        used.
        log: The events.
        noises: Process noises to fit; None for all. The variances of rows are always fitted.
        rounds: Largest number of pairs of rounds.
        tolerance: Largest relative change of a variance in a round that counts as converged.

    Raises:
        EstimatorError: If filter or model do not meet the assumptions.

    Warns:
        RuntimeWarning: If the variances still change after all rounds.
    """
    fold = _folded(estimator, model, tuning, log)
    _check(fold)
    chosen = [noises is None or noise.name in noises for noise in model.noises]
    begin = np.concatenate((tuning.q, tuning.r))
    moving = np.concatenate((np.array(chosen, bool), np.ones(tuning.r.size, bool))) & (begin > 0.0)

    def at(logs: np.ndarray) -> Fold:
        values = begin.copy()
        values[moving] = np.exp(logs)
        tuned = replace(tuning, q=values[: tuning.q.size], r=values[tuning.q.size :])
        return _folded(estimator, model, tuned, log)

    def onward(fold: Fold, logs: np.ndarray) -> np.ndarray:
        found = np.concatenate(_round(fold))[moving]
        return np.where(found > 0.0, np.log(np.where(found > 0.0, found, 1.0)), logs)

    logs = np.log(begin[moving])
    likelihoods, converged, change = [_likelihood(fold)], False, np.inf
    while not converged and len(likelihoods) <= rounds:
        first = onward(fold, logs)
        second = onward(at(first), first)
        change = float(np.max(np.abs(second - first), initial=0.0))
        converged = change < tolerance
        logs, fold = _better(logs, first, second, at)
        likelihoods.append(_likelihood(fold))
    if not converged:
        text = (
            f"em: not converged after {rounds} pairs of rounds: a variance changes by {change:.2g} of itself per round"
        )
        warnings.warn(f"{text} (tolerance {tolerance:g}); give more rounds", RuntimeWarning, stacklevel=2)
    return EmFit(fold.tuning, np.array(likelihoods), converged, change)


def _better(
    logs: np.ndarray, first: np.ndarray, second: np.ndarray, at: Callable[[np.ndarray], Fold]
) -> tuple[np.ndarray, Fold]:
    """Return the extrapolation of two rounds, unless it lowers the likelihood; else their result.

    Source: Varadhan & Roland (2008), doi:10.1111/j.1467-9469.2007.00585.x, SqS3.
    """
    fold = at(second)
    by, bend = first - logs, (second - first) - (first - logs)
    if not np.linalg.norm(bend) > 0.0:
        return second, fold
    length = np.linalg.norm(by) / np.linalg.norm(bend)
    if length <= 1.0:
        return second, fold
    guess = logs + 2.0 * length * by + length**2 * bend
    if np.all(np.abs(guess - second) < MAX_EXTRAPOLATION):
        beyond = at(guess)
        if _likelihood(beyond) >= _likelihood(fold):
            return guess, beyond
    return second, fold


def _folded(estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log) -> Fold:
    pairs = np.stack(np.triu_indices(model.nx, 1), axis=1)
    fold = Fold(estimator, model, tuning, log, pairs=pairs)
    fold.advance()
    return fold


def _likelihood(fold: Fold) -> float:
    return float(fold.track.log_likelihood[fold.track.verdict == USED].sum())


def _check(fold: Fold) -> None:
    """Refuse a filter or a model for which the equations do not hold."""
    name, model = fold.estimator.name, fold.model
    check_smooth(fold.estimator, model, fold.options)
    if fold.estimator.samples:
        raise EstimatorError(f"em: {name} draws at random; use a Gaussian filter")
    if model.correlated:
        raise EstimatorError(f"em: rows of a sensor of {model.name} are correlated, and each variance is fitted alone")
    if len(model.shown) < model.nx:
        raise EstimatorError(f"em: {model.name} has {model.nx:,} states, of which a track keeps some")
    context, n = fold.machine.context, model.nx
    x, dt = np.array(fold.prior[0]), min(1.0, model.max_step)
    S, Q, scratch = np.zeros((len(model.noises), n, n)), np.zeros((n, n)), np.empty((n, n))
    shapes(context, x, fold.u, dt, S, scratch)
    add_process_noise(context, x, fold.u, dt, Q, scratch)
    if not np.allclose(np.tensordot(fold.tuning.q, S, 1), Q, rtol=1e-9, atol=0.0):
        raise EstimatorError(f"em: Q of {model.name} is not linear in its noises")


def _round(fold: Fold) -> tuple[np.ndarray, np.ndarray]:
    """Return q (nw,) and r (rows,) from the smoothed states and measurements; NaN without information."""
    model, log, n = fold.model, fold.log, fold.model.nx
    lag = np.empty((fold.n, n, n))
    out = Smoothed.room_for(fold)
    assert fold.estimator.smoothing is not None
    Walk(fold, MomentsBack(fold, fold.estimator.smoothing, out, lag)).back()
    cov = covariances(out.std, out.cross)
    rows = slice(0, fold.n)
    over_q, over_r = np.zeros((2, len(model.noises))), np.zeros((2, fold.tuning.r.size))
    u = model.default_inputs.copy()
    gather(
        fold.machine.context, log.t[rows], log.kind[rows], log.channel[rows], log.value[rows], log.width,
        fold.track.verdict, fold.track.screened, out.mean, cov, lag, u, np.asarray(model.row_start, np.int64),
        over_q, over_r,
    )  # fmt: skip
    with np.errstate(invalid="ignore", divide="ignore"):
        return fold.tuning.q * np.where(over_q[1] > 0.0, over_q[0] / over_q[1], 1.0), over_r[0] / over_r[1]


@jit
def shapes(context, x, u, dt, S, scratch):
    """Fill Sⱼ (nx, nx) for each noise: Q for a variance of 1, with all others 0."""
    q = process_variances(context)
    kept = q.copy()
    for j in range(q.size):
        q[:] = 0.0
        q[j] = 1.0
        S[j] = 0.0
        add_process_noise(context, x, u, dt, S[j], scratch)
    copy_vector(kept, q)


@jit
def gather(
    context, t, kind, channel, value, width, verdict, screened, mean, cov, lag, u, row_start, over_q, over_r
):  # fmt: skip
    """Add up numerators and denominators of q (2, nw) and r (2, rows) over the events, whose states are smoothed."""
    n = context.nx
    scratch = np.empty((n, n))
    H = np.empty((context.width, n))
    expected = np.empty(context.width)
    jacobian = np.empty(scratch_size(n, max(n, context.width)))
    before = -1
    for i in range(t.size):
        what = kind[i]
        if what != READING and what != INPUT and what != RESET:
            continue
        if before >= 0 and what != RESET and t[i] > t[before] and np.isfinite(lag[i, 0, 0]):
            dt = (t[i] - t[before]) * 1e-9
            add_step(context, mean[before], cov[before], mean[i], cov[i], lag[i], u, dt, jacobian, scratch, over_q)
        before = i
        if what == INPUT:
            for j in range(u.size):
                if np.isfinite(value[i, j]):
                    u[j] = value[i, j]
        if what == READING and verdict[i] == USED:
            sensor = channel[i]
            m = sensor_rows(context, sensor)[1]
            circular = circular_rows(context, sensor)
            sensor_jacobian(context, sensor, mean[i], u, H[:m], jacobian)
            expect(context, sensor, mean[i], u, expected)
            for k in range(m):
                own = width + k < value.shape[1] and np.isfinite(value[i, width + k])
                if own or screened[i, k] != 0 or not np.isfinite(value[i, k]):
                    continue
                off = value[i, k] - expected[k]
                if circular[k] != 0:
                    off = wrap(off)
                over_r[0, row_start[sensor] + k] += off * off + H[k] @ cov[i] @ H[k]
                over_r[1, row_start[sensor] + k] += 1.0


@jit
def add_step(context, x, P, ahead, P_ahead, L, u, dt, jacobian, scratch, over_q):
    """Add one step's tr(Q⁻¹ Sⱼ Q⁻¹ E[w wᵀ]) and tr(Q⁻¹ Sⱼ), over all sub-steps of the model."""
    n = x.size
    nw = over_q.shape[1]
    S, T = np.zeros((nw, n, n)), np.empty((nw, n, n))
    whole, F = np.eye(n), np.empty((n, n))
    at, to = x.copy(), np.empty(n)
    steps = steps_of(dt, context.max_step)
    for _ in range(steps):
        state_jacobian(context, at, u, dt / steps, F, jacobian)
        shapes(context, at, u, dt / steps, T, scratch)
        for j in range(nw):
            S[j] = F @ np.ascontiguousarray(S[j]) @ F.T + T[j]
        whole = F @ whole
        transition(context, at, u, dt / steps, to)
        at[:] = to
    circular = circular_states(context)
    d = ahead - at
    for i in range(n):
        if circular[i] != 0:
            d[i] = wrap(d[i])
    C = whole @ L
    E = P_ahead - C - C.T + whole @ P @ whole.T + np.outer(d, d)
    q = process_variances(context)
    Q = np.zeros((n, n))
    for j in range(nw):
        Q += q[j] * S[j]
    if not root(Q, Q, n):
        return
    W = np.empty((n, n))
    solve_semidefinite(Q, E, W)
    for j in range(nw):
        A = S[j].copy()
        solve_semidefinite(Q, A, W)
        over_q[1, j] += np.trace(A)
        over_q[0, j] += np.sum(A * E.T)
