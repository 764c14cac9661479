"""Go back over a particle filter by trajectories: each is drawn from the last cloud, then from event to event backward.

A trajectory that stands at x' after an event goes back to the particle xᵢ before it with probability

    wᵢ p(x' | xᵢ) / Σⱼ wⱼ p(x' | xⱼ),     p(x' | x) = N(x'; f(x), Q)

so the trajectories are draws from the smoothing distribution, whatever its shape. Where the model takes several steps
between two events, they pass the clouds between these. The kernel of `pf-reg` is no part of p: where it is wide
beside Q, the particles it has moved go back to too few. Moments of K trajectories scatter by 1/√K.

Source: Godsill, Doucet & West (2004), doi:10.1198/016214504000000151.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import add_process_noise, steps_of, transition_points
from ..errors import EstimatorError
from ..estimator import call_predict
from ..fold import Fold
from ..interpreted.fold_loop import MAX_PREDICT_STEPS, UNSET
from ..log import INPUT, RESET
from ..numerics.jit import jit
from ..numerics.linalg import wrapped
from ..particle.cloud import weights_of
from ..snapshots import Snapshot
from .walk import QUERIES, Smoothed, StateJump, Stretch

TRAJECTORIES = 200


@jit
def moved(context, X, u, dt, out, Qs, scratch):
    """Fill out (N, nx) with f of the particles, and Qs (N or 1, nx, nx), zero on entry, with the noise of a step."""
    transition_points(context, X, u, dt, out)
    for i in range(Qs.shape[0]):
        add_process_noise(context, X[i], u, dt, Qs[i], scratch)


@jit
def predict_once(code, context, u, dt, index, state, work):
    """One step of the filter."""
    call_predict(code.predict, context, u, dt, index, state, work)


class TrajectoriesBack:
    """Fills `out` on its way; see `Notes`. Draws are a function of the seed and the event."""

    def __init__(self, fold: Fold, out: Smoothed) -> None:
        self._fold, self._log, self._machine, self._out = fold, fold.log, fold.machine, out
        self._options, self._context = fold.options, fold.machine.context
        model = fold.model
        self._circular, self._shown = np.asarray(model.circular, bool), model.shown
        self._varies = bool(self._context["Q_varies"])
        self.each = fold.machine.fresh().state.nbytes
        self._check(min(1.0, model.max_step))
        here = fold.base_here().state
        assert here is not None
        self._at = self._drawn(fold.n, here)
        self._later: tuple[np.ndarray, int] | None = None

    def _check(self, dt: float) -> None:
        """Refuse a model whose next state has no density: no particle but its own parent then leads to it.

        Raises:
            EstimatorError: With the states that have no noise.
        """
        model = self._fold.model
        if model.mode >= 0:
            raise EstimatorError(
                f"{self._fold.estimator.name} cannot be smoothed: {model.name} has a mode that jumps, and trajectories "
                "go back by a Gaussian density; use a Gaussian filter"
            )
        _, Qs = self._moved(self._machine.prior[0][None, :].copy(), self._fold.u, dt)
        bare = [name for name, variance in zip(model.state_names, np.diag(Qs[0]), strict=True) if not variance > 0.0]
        scale = np.sqrt(np.diag(Qs[0]))
        if bare or np.linalg.matrix_rank(Qs[0] / np.outer(scale, scale)) < model.nx:
            what = f"{', '.join(bare[:4])} has no noise of its own" if bare else "Q is singular"
            raise EstimatorError(
                f"{self._fold.estimator.name} cannot be smoothed: in {model.name} {what}, so there is no density by "
                "which trajectories go back; give it a small Q, or use a Gaussian filter"
            )

    def room(self, events: int) -> None:
        """See `Notes`."""
        self._states = np.empty((events, self.each // 8))

    def forward(self, part: Stretch, now: Snapshot, row: int) -> np.ndarray:
        """See `Notes`."""
        spare = now.state.copy()
        for i in range(part.start, part.stop):
            query = self._log.kind[i] in QUERIES or part.state >= 0
            _, answer = self._machine.run_apart(self._log, i, i + 1, now, judged=False)
            if query:
                spare = answer
            self._states[row + i - part.start] = spare if query else now.state
        return spare

    def back(self, part: Stretch, row: int, before: Snapshot, jump: StateJump | None) -> None:
        """See `Notes`."""
        log = self._log
        outside = jump is not None
        clock, u = int(before.clock[0]), before.u.copy()
        clock = int(log.t[part.start]) if clock == UNSET else clock
        state, came = before.state, []
        for i in range(part.start, part.stop):
            query, own = log.kind[i] in QUERIES, self._states[row + i - part.start]
            came.append((i, query, own, clock, u.copy(), state))
            if not query:
                clock, state = int(log.t[i]), own
                if log.kind[i] == INPUT:
                    given = log.value[i, : u.size]
                    u = np.where(np.isfinite(given), given, u)
        for i, query, own, clock, u, state in reversed(came):
            t = int(log.t[i])
            if query:
                self._tell(i, self._at if t == clock else self._asked(i, own, t, u))
                continue
            self._tell(i, self._at)
            if outside and part.state >= 0:
                self._at = self._drawn(i, own)
            self._later = None if log.kind[i] == RESET else (self._at, t)
            # After a reset or a widened covariance there is no information on the states before.
            if log.kind[i] == RESET or (outside and i == part.start and part.sensor >= 0):
                self._at = self._drawn(i, state)
            else:
                self._at = self._gone_back(i, self._at, state, clock, t, u)

    def _asked(self, i: int, answer: np.ndarray, t: int, u: np.ndarray) -> np.ndarray:
        """Return the trajectories at a query between two events."""
        if self._later is None:
            return self._drawn(i, answer)
        return self._gone_back(i, self._later[0], answer, t, self._later[1], u)

    def _gone_back(self, i: int, at: np.ndarray, state: np.ndarray, clock: int, t: int, u: np.ndarray) -> np.ndarray:
        """Return the trajectories at `clock` that lead to `at` (K, nx) at time t, in the clouds from `state` on."""
        dt, longest = (t - clock) * 1e-9, self._fold.model.max_step
        if dt <= 0.0:
            return at
        if dt > MAX_PREDICT_STEPS * longest:
            return self._drawn(i, state)
        steps = steps_of(dt, longest)
        states = [state]
        for _ in range(steps - 1):
            ahead = states[-1].copy()
            predict_once(self._machine.code, self._context, u, dt / steps, i, ahead, self._machine.work)
            states.append(ahead)
        rng = self._rng(i)
        for each in reversed(states):
            w, X = weights_of(self._options, each, self._fold.model.nx)
            with np.errstate(divide="ignore"):
                score = np.log(w) - 0.5 * self._distances(at, X, u, dt / steps)
            p = np.cumsum(np.exp(score - score.max(axis=1, keepdims=True)), axis=1)
            draws = rng.random(len(at)) * p[:, -1]
            at = X[[int(np.searchsorted(row, draw, side="right")) for row, draw in zip(p, draws, strict=True)]].copy()
        return at

    def _distances(self, at: np.ndarray, X: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Return -2 log p(x' | x) up to a constant, of trajectories and particles, (K, N)."""
        forward, Qs = self._moved(X, u, dt)
        if not self._varies and not self._circular.any():
            L = np.linalg.cholesky(Qs[0])
            from scipy.spatial.distance import cdist  # takes longer to import than this module

            return cdist(np.linalg.solve(L, at.T).T, np.linalg.solve(L, forward.T).T, "sqeuclidean")
        inverse = np.linalg.inv(Qs)
        log_det = np.linalg.slogdet(Qs)[1]
        found = np.empty((len(at), len(X)))
        for k, x in enumerate(at):
            off = wrapped(x - forward, self._circular)
            found[k] = np.einsum("ni,nij,nj->n", off, np.broadcast_to(inverse, (len(X), *inverse.shape[1:])), off)
        return found + log_det

    def _moved(self, X: np.ndarray, u: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return f of particles (N, nx), and the covariances of a step's noise, (N, nx, nx), or (1, nx, nx) for all."""
        n = X.shape[1]
        forward, Qs = np.empty((len(X), n)), np.zeros((len(X) if self._varies else 1, n, n))
        moved(self._context, np.ascontiguousarray(X), u, dt, forward, Qs, np.empty((n, n)))
        return forward, Qs

    def _rng(self, i: int) -> np.random.Generator:
        return np.random.default_rng([self._fold.tuning.seed, self._log.first + i])

    def _drawn(self, i: int, state: np.ndarray) -> np.ndarray:
        """Return trajectories (K, nx) that begin in the cloud of a state."""
        w, X = weights_of(self._options, state, self._fold.model.nx)
        return np.asarray(X[self._rng(i).choice(len(w), TRAJECTORIES, p=w)])

    def _tell(self, i: int, at: np.ndarray) -> None:
        off = wrapped(at - at[0], self._circular)
        mean = wrapped(at[0] + off.mean(axis=0), self._circular)
        cov = np.atleast_2d(np.cov(off.T))
        self._out.mean[i], self._out.std[i] = mean[self._shown], np.sqrt(np.diag(cov))[self._shown]
        first, second = self._fold.pairs.T
        self._out.cross[i] = cov[first, second]
