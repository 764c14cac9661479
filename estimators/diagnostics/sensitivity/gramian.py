"""Observability along the track: information of measurements about the state at their beginning.

The prior mean of each state is nudged, in units of its deviation, and the same log folded again. With P₀ = I in these
units, and J = Oᵀ N⁻¹ O the information of the measurements on the state at their beginning (process noise is in N),

    G_ij = Σ dν_iᵀ S⁻¹ dν_j = (I + J⁻¹)⁻¹,        I - G = (I + J)⁻¹

so I - G is the covariance of that state after the measurements, as a share of that before, and the eigenvalues
g of G give those of J, the stochastic observability Gramian: g / (1 - g). Exact for linear models, the derivative along
the track for others.

A state that forgets its beginning quickly (a lag, a disturbance that decays) is not determined by these
measurements, and needs not be: its prior is without effect. So the same nudges give Ψ = ∂x(T) / ∂x(0), how much of an
error of the prior is left in the estimate at the end. A state is unobserved if neither determines it.

Source: Σ dνᵀS⁻¹dν is the information of the marginal likelihood, Oᵀ (O Oᵀ + N)⁻¹ O; the second form is Woodbury's
identity. For the Gramian: Jazwinski (1970), Stochastic Processes and Filtering Theory, 7.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np

from ...fold import Fold
from ...log import Log
from ...model.state_space import StateSpaceModel
from ...snapshots import Base
from ...track import USED, Track
from ...tuning import Tuning
from .responses import (
    STEP,
    Nudge,
    Start,
    astray,
    digits,
    each,
    max_events,
    nonlinear_note,
    reason_against,
    stand_in,
)

RANK_INFORMATION = 1.0
"""Information, in units of the prior's, from which the measurements determine a direction better than the prior."""

MIN_VARIANCE_SHARE = 1e-9
"""Least share of the prior's variance that differences tell from zero; no eigenvalue is larger than its reciprocal."""

MAX_PRIOR_LEFT = 0.9  # share of the prior deviation from which a state is not observed
MAX_FORGOTTEN_SHARE = 0.1  # share of an error of the prior that is left at the end, up to which it is forgotten

MAX_LINEAR_EIGENVALUE = 1.05
"""Eigenvalue of G from which the filter responds nonlinearly to nudges: for a linear model none is above 1."""


class GramianView(NamedTuple):
    """Information of the measurements of a part of the log about the state at its beginning.

    begin, end: ns. gramian (nx, nx): J, in the prior's standard deviations; eigenvalues (nx,), ascending. rank: number
    of those that the measurements determine better than the prior; conditioning: largest over smallest. deviation
    (nx,): remaining share of each state's prior standard deviation. kept (nx,): largest share of an error of the prior
    that is left in a state at the end, in prior deviations. forgotten: number of directions that the measurements do
    not determine and the end does not depend on; conditioning leaves them out. weakest (nx,): direction of the smallest
    eigenvalue of the others, in the prior's standard deviations; text describes it. beyond: the response to nudges was
    nonlinear, so the result is unreliable.
    """

    begin: int
    end: int
    gramian: np.ndarray
    eigenvalues: np.ndarray
    rank: int
    conditioning: float
    deviation: np.ndarray
    kept: np.ndarray
    forgotten: int
    weakest: np.ndarray
    text: str
    beyond: bool

    @property
    def left(self) -> np.ndarray:
        """Share of the prior deviation of each state that measurements leave, or time where they tell none, (nx,)."""
        return np.where(self.deviation > MAX_PRIOR_LEFT, np.minimum(self.deviation, self.kept), self.deviation)

    @property
    def summary(self) -> str:
        """Rank and conditioning in words."""
        forgotten = f" ({self.forgotten} forgotten)" if self.forgotten else ""
        return f"rank {self.rank} of {self.deviation.size}{forgotten}, conditioning {digits(self.conditioning)}"

    def unobserved(self, model: StateSpaceModel) -> list[str]:
        """Return the states that keep their prior."""
        free = np.flatnonzero((model.prior_std > 0.0) & (self.left > MAX_PRIOR_LEFT))
        return [model.state_names[int(j)] for j in free]


class Gramian(NamedTuple):
    """Observability from a whole log, and from each of its windows alone; `reason`, `note` as in `Sensitivity`."""

    estimator: str
    reason: str
    note: str
    whole: GramianView | None
    windows: tuple[GramianView, ...]


def gramian(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    *,
    base: Base | None = None,
    windows: int = 8,
    executor: Executor | str | None = "threads",
) -> Gramian:
    """Nudge the prior mean of each state, and compute the information of a log about it.

    Args:
        estimator: Of the twin; particle and ensemble filters are replaced by a deterministic one, see `note`.
        model: Of at most 64 states.
        tuning: As the twin's.
        log: The events; it must not grow meanwhile (give a copy).
        base: Where the log starts, if older events were dropped.
        windows: Parts of equal time, or 0. Each begins at the estimate of that time with the covariance of the prior.
        executor: As `sensitivity`.

    Raises:
        EstimatorError: As `Fold`.
        ModelError: As `Fold`.
    """
    name, note = stand_in(estimator, model)
    reason = reason_against(model, log)
    if reason:
        return Gramian(name, reason, note, None, ())
    if name != estimator:
        tuning = tuning.with_options({})
    fold = Fold(name, model, tuning, log, base=base)
    t = log.events.t
    begin = max(0, log.n - max_events(model, 2 * model.nx))
    cuts = np.searchsorted(t, np.linspace(t[begin], t[-1], windows + 1)[1:-1])
    begins = [begin, *(int(k) for k in cuts)]
    bases = []
    for k in begins:
        fold.advance(k - fold.n)
        mean, _ = fold.moments()
        bases.append(Base(mean, model.prior_cov, fold.clock, fold.u))
    reason = astray(estimator, name, fold.track)
    if reason:
        return Gramian(name, reason, note, None, ())
    spans = list(zip(begins, [*begins[1:], log.n], bases, strict=True))
    spans = [(begin, log.n, bases[0]), *(span for span in spans if windows and span[1] > span[0])]
    parts = tuple(_part(log, *span) for span in spans)
    tracks = each(partial(_track, name, tuning, parts), range(len(parts)), executor)
    begun = [Start(name, tuning, *part, 0, "", track) for part, track in zip(parts, tracks, strict=True)]
    items = [(k, j) for k in range(len(parts)) for j in range(model.nx)]
    responses = iter(each(partial(_response, begun), items, executor))
    views = [_view(one, [next(responses) for _ in range(model.nx)]) for one in begun]
    if any(view.beyond for view in views):
        note = "; ".join(filter(None, [note, nonlinear_note(name, tuning, "the Gramian is unreliable")]))
    return Gramian(name, "", note, views[0], tuple(views[1:]))


def _part(log: Log, begin: int, end: int, base: Base) -> tuple[Log, Base]:
    part = log.copy()
    part.n = end
    if begin:
        part.drop_front(begin)
    return part.copy(), base  # without the room of the others, since processes send it


def _track(estimator: str, tuning: Tuning, parts: Sequence[tuple[Log, Base]], k: int) -> Track:
    """Return the track of part k."""
    return Start.of(estimator, tuning, *parts[k]).track


def _view(begun: Start, responses: Sequence[tuple[np.ndarray, np.ndarray]]) -> GramianView:
    """Return the information of a part by the responses to each state."""
    model, part = begun.tuning.model, begun.log
    g = information([whitened for whitened, _ in responses])
    # Of a state that is certain at first there is no share.
    scale = np.where(model.prior_std > 0.0, model.prior_std, np.inf)[model.shown]
    influence = np.array([states / scale for _, states in responses])
    values, vectors = np.linalg.eigh(g)
    left = np.clip(1.0 - values, MIN_VARIANCE_SHARE, 1.0)
    # A state that is certain at first cannot be nudged.
    free = model.prior_std > 0.0
    eigenvalues = np.clip(values, 0.0, None) / left
    ends = np.abs(vectors.T @ influence).max(axis=1, initial=0.0)
    forgotten = (eigenvalues <= RANK_INFORMATION) & (ends <= MAX_FORGOTTEN_SHARE)
    moved = [k for k in range(model.nx) if np.any(np.abs(vectors[free, k]) > MIN_VARIANCE_SHARE)]
    order = [k for k in moved if not forgotten[k]]
    weak = vectors[:, order[0]] if order else np.zeros(model.nx)
    weak = weak * (np.sign(weak[np.argmax(np.abs(weak))]) or 1.0)
    kept = eigenvalues[order]
    return GramianView(
        begin=int(part.t[0]),
        end=int(part.t[part.n - 1]),
        gramian=(vectors * eigenvalues) @ vectors.T,
        eigenvalues=eigenvalues,
        rank=int(np.sum(eigenvalues > RANK_INFORMATION)),
        conditioning=float(kept[-1] / kept[0]) if kept.size and kept[0] > 0.0 else np.inf,
        deviation=np.sqrt((vectors**2) @ left),
        kept=np.abs(influence).max(axis=1, initial=0.0),
        forgotten=len(moved) - len(order),
        weakest=weak,
        text=_in_words(weak, model, float(left[order[0]]) if order else 0.0) if order or not moved else FORGOTTEN,
        beyond=bool(np.any(values > MAX_LINEAR_EIGENVALUE)),
    )


FORGOTTEN = "every state forgets its prior"


def _response(begun: Sequence[Start], item: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the response of part k to one prior deviation of state j: `whitened` where used, and `states` at its end.

    A whole `Response` would be most of the data that a process sends.
    """
    one, j = begun[item[0]], item[1]
    std = one.tuning.model.prior_std[j]
    tracks = []
    for size in (-STEP, STEP):
        mean = one.base.mean.copy()
        mean[j] += size * std
        tracks.append(one.refold(base=one.base._replace(mean=mean)))
    moved = one.moved(tracks[1], tracks[0])
    used = one.track.verdict == USED
    return moved.whitened[used] / (2.0 * STEP), moved.states[-1] / (2.0 * STEP)


def _in_words(weights: np.ndarray, model: StateSpaceModel, left: float) -> str:
    """Describe the weakest direction: its largest parts in units, and its remaining share of the prior deviation."""
    parts = [
        f"{model.state_names[int(j)]} {weights[j] * model.prior_std[j]:+.3g} {model.states[int(j)].unit}"
        for j in np.argsort(-np.abs(weights), kind="stable")[:4]
        if np.abs(weights[j]) >= 0.1 * np.abs(weights).max(initial=0.0) and weights[j] != 0.0
    ]
    if not parts:
        return "every state is certain"
    together = f"{parts[0]} with {', '.join(parts[1:])}" if len(parts) > 1 else parts[0]
    return f"{together}: {100 * np.sqrt(left):.3g} % of its prior deviation is left"


MIN_EIGENVALUE = 1e-10
"""Eigenvalue of the information, scaled to a unit diagonal, that differences cannot distinguish from zero."""

MIN_NULL_SHARE = 1e-3  # Share of a nudge in a direction below which it is not part of it
MIN_NAMED_SHARE = 0.05  # Share of the largest part of a direction below which another is not named


class Direction(NamedTuple):
    """A combination of nudges, and how well the log determines it.

    `weights` (k,) are in the nudges' scales, with unit norm; `deviation`, of the combination, in the same: beyond 1,
    the log does not determine it to the size of the values. `text` describes it.
    """

    weights: np.ndarray
    deviation: float
    text: str


class Uncertainty(NamedTuple):
    """Uncertainty of some nudges if all of them are unknown together.

    deviation (k,): in the nudges' units, infinite where the log does not determine it; alone (k,): the same if all
    others are known. correlation (k, k): of the estimates; near ±1, two nudges cannot be distinguished.
    """

    deviation: np.ndarray
    alone: np.ndarray
    correlation: np.ndarray


def information(whitened: Sequence[np.ndarray]) -> np.ndarray:
    """Return F (k, k) of k responses S^-1/2 dν, each (N, ny), NaN where there is none."""
    rows = np.array([np.nan_to_num(each).ravel() for each in whitened])
    return rows @ rows.T


def uncertainty(fisher: np.ndarray) -> Uncertainty:
    """Invert the information (k, k) of k nudges, as far as possible."""
    with np.errstate(divide="ignore"):
        alone = np.diag(fisher) ** -0.5
    seen = np.isfinite(alone)
    unit = np.where(seen, alone, 0.0)
    values, vectors = np.linalg.eigh(fisher * np.outer(unit, unit))
    determined = values > MIN_EIGENVALUE
    shares = vectors**2
    spread = shares[:, determined] @ (1.0 / values[determined])
    lost = ~seen | (shares[:, ~determined].sum(axis=1) > MIN_NULL_SHARE**2)
    deviation = np.where(lost, np.inf, np.sqrt(spread) * unit)
    # The null space dominates the correlation of what the log does not determine.
    weight = np.where(determined, 1.0 / np.maximum(values, MIN_EIGENVALUE), 1.0 / MIN_EIGENVALUE)
    cov = (vectors * weight) @ vectors.T
    root = np.sqrt(np.diag(cov))
    return Uncertainty(deviation, alone, cov / np.outer(root, root))


def directions(fisher: np.ndarray, nudges: Sequence[Nudge]) -> tuple[Direction, ...]:
    """Return independent combinations of nudges, the least determined first."""
    scale = np.array([nudge.scale for nudge in nudges])
    values, vectors = np.linalg.eigh(fisher * np.outer(scale, scale))
    least = MIN_EIGENVALUE * max(float(values.max(initial=0.0)), np.finfo(float).tiny)
    found = []
    for value, weights in zip(values, vectors.T, strict=True):
        weights = weights * (np.sign(weights[np.argmax(np.abs(weights))]) or 1.0)
        deviation = float(value**-0.5) if value > least else np.inf
        found.append(Direction(weights, deviation, in_words(weights, nudges)))
    return tuple(found)


def in_words(weights: np.ndarray, nudges: Sequence[Nudge], most: int = 4) -> str:
    """Describe a combination of nudges: its largest parts, parameters in percent of their values, others in units."""
    order = np.argsort(-np.abs(weights), kind="stable")
    order = order[np.abs(weights[order]) >= MIN_NAMED_SHARE * np.abs(weights[order[0]])]
    largest = np.abs(weights[order[0]])
    parts = [nudges[j].in_words(float(weights[j] / largest) * nudges[j].scale) for j in order[:most]]
    more = f" and {len(order) - most} more" if len(order) > most else ""
    return (f"{parts[0]} with {', '.join(parts[1:])}" if len(parts) > 1 else parts[0]) + more
