"""Uncertainty of a fit: covariance by curvature, and intervals by profile likelihood where the curvature is not enough.

Near the maximum the penalised likelihood is that of a Gaussian with the covariance H⁻¹, H minus its second derivatives
(Laplace). They are taken by differences over about one deviation, so they describe the maximum over the width of the
interval, undisturbed by the gate or by random draws. H⁻¹ is right if the model is. Real innovations are correlated, so
the likelihood counts their information too often, and the covariance is H⁻¹ J H⁻¹ with J that of the score, from sums
over batches of time. The wider of the two is used.

`parameter_widths` says how uncertain parameters are, fitted or not, for filters that consider them. Near p the
standardised innovations and errors of references z_t (one per row) move by z_t + Z_t δ. Weighted by w = 1 / τ_row, with
the correlation time of each row, least squares have the information G = Σ w Z_tᵀ Z_t and the score Σ s_t with
s_t = - w Z_tᵀ z_t, and the covariance of their minimum is G⁻¹ J G⁻¹ with J = Var Σ s_t (Godambe). J is estimated by
sums over batches of time, so that errors may last. A parameter that the recording excites once has hardly more than one
batch, and its own fit explains that away; so J is taken as no less than its mean inflation τ ≥ 1 in units of G:

    J = G^½ max(τ I, B) G^½,   B = G^-½ (Σ_batches s sᵀ) G^-½,   τ = max(1, tr B / k)

Under the prior N(0, D²) of the data sheet, the covariance is (G J⁻¹ G + D⁻²)⁻¹: directions that the data do not
determine keep their prior width. If p is not the minimum, the step to it, d = (G / τ + D⁻²)⁻¹ Σ s_t / τ, adds d dᵀ.

That is the accuracy of common values. Of K recordings of one specimen each, with steps d_k and variances C_k of their
own, the variance between specimens is (D² + Σ (d_k - d̄)² + (1 - 1/K) Σ C_k) / K, with D² as one of them: D² for K = 1.

The profile likelihood of entry i, 2 (l(θ̂) - max over all others of l(θ_i = t)) = z², has one solution on either side,
or none where the data do not identify the entry; then the interval ends at the range. The signed root of the left side
is nearly linear in t, so a few secant steps find it.

Sources: Abramowitz & Stegun (1964), 25.3.27, for the differences; White (1982), doi:10.2307/1912526, for H⁻¹ J H⁻¹;
Godambe (1960), doi:10.1214/aoms/1177705693, for G J⁻¹ G; Newey & West (1987), doi:10.2307/1913610, for J of correlated
scores, and Carlstein (1986), doi:10.1214/aos/1176350057, for sums over batches; Ledoit & Wolf (2004),
doi:10.1016/S0047-259X(03)00096-4, for shrinkage of such a matrix; Venzon & Moolgavkar (1988),
doi:10.2307/2347496, for the profile.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np

from ..diagnostics.references import references
from ..log import INPUT, Events
from ..model.state_space import StateSpaceModel
from ..track import USED, Track
from .aims import MAX_ERROR, WITNESSES, Aim, correlation_time, track_of
from .entries import Setting
from .objective import Go, Objective, each_folded, quasi_newton
from .recording import Recording

Z = 1.959963984540054  # Half-width of a 95 % interval, in deviations
SCORE_BATCHES = 40  # Batches of time whose scores are summed

MIN_CURVATURE = 1e-8
"""Share of the largest eigenvalue of H, in units of its diagonal, below which there is no curvature."""

MAX_CORRELATION = 0.1
"""Correlation of two entries' scores, with two standard errors, up to which it is not checked by second derivatives: an
error of that size changes a deviation by half a percent."""

NEARBY = 0.5  # Deviations within which the correlations of a curvature hold

MAX_MISFIT = 0.2  # Share by which the drop at the end of an interval may differ from that of a parabola, in its root

MIN_LOOSENESS = 0.1
"""Share of the weak prior's deviation above which an entry may need a profile. Below it, only the gate makes the
likelihood rough."""

MAX_SECANTS = 3  # Most points of a profile on one side
ROOT_TOLERANCE = 0.05  # Relative error of the root at the end of an interval
PROFILE_STEPS = 3  # Steps over the other entries, which start at the maximum of the parabola


class LikelihoodCurvature(NamedTuple):
    """Shape of a maximum.

    cov (k, k) is H⁻¹ on the scales of the fit; `widened` (k,) the factor, at least 1, by which correlated scores widen
    the deviations.
    """

    cov: np.ndarray
    widened: np.ndarray

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation of every entry (k,)."""
        return np.sqrt(np.diag(self.cov)) * self.widened

    @property
    def correlation(self) -> np.ndarray:
        """Correlation of the estimates (k, k)."""
        return _scaled(self.cov)

    @property
    def lines(self) -> np.ndarray:
        """Change of all entries per unit of each, (k, k), along which the parabola drops as its profile."""
        return self.cov / np.diag(self.cov)[:, None]


def curvature_points(k: int) -> int:
    """Return the number of points that the curvature of k entries takes at most."""
    return 1 + 2 * k + k * (k - 1)


def curvature(objective: Objective, x: np.ndarray, known: np.ndarray | None = None) -> LikelihoodCurvature:
    """Return the curvature at a maximum x (k,).

    The second derivatives of two entries take two folds, so they are taken only of those that can be correlated. That
    of others follows from the diagonal and from the correlation of their scores, which is below `MAX_CORRELATION`.

    Args:
        objective: The objective.
        x: Its maximum.
        known: Curvature H at a point nearby (k, k), whose correlations hold here.
    """
    k = x.size
    _, scores = objective.slopes(x)
    precision = objective.precision
    outer = scores @ scores.T + np.diag(precision)
    if objective.progress.stop:
        rough: np.ndarray = np.linalg.inv(outer)
        return LikelihoodCurvature(rough, _widened(rough, scores, precision))
    low, high = objective.limits
    # The points stay within the range: at its edge they are about a point inside.
    steps = np.minimum(1.0 / np.sqrt(np.diag(outer)), (high - low) / 4.0)
    centre = np.clip(x, low + steps, high - steps)
    correlation = _scaled(outer if known is None else known)
    # The largest that chance leaves of a correlation, at two standard errors.
    chance = 2.0 / max(1, int(np.count_nonzero(np.any(scores != 0.0, axis=0)))) ** 0.5
    pairs = [
        (i, j) for i in range(k) for j in range(i)
        if known is None and abs(correlation[i, j]) + chance > MAX_CORRELATION
    ]  # fmt: skip
    unit = np.diag(steps)
    points = [centre]
    points += [centre + sign * unit[i] for i in range(k) for sign in (1.0, -1.0)]
    points += [centre + sign * (unit[i] + unit[j]) for i, j in pairs for sign in (1.0, -1.0)]
    values = np.array([terms.sum() for terms in objective.all_terms(points)])
    middle, single, double = values[0], values[1 : 1 + 2 * k].reshape(k, 2), values[1 + 2 * k :].reshape(-1, 2)
    diagonal = (2.0 * middle - single.sum(axis=1)) / steps**2 + precision
    H = correlation * np.sqrt(np.outer(diagonal, diagonal)) if np.all(diagonal > 0.0) else np.diag(diagonal)
    for (i, j), both in zip(pairs, double, strict=True):
        mixed = both.sum() - single[i].sum() - single[j].sum() + 2.0 * middle
        H[i, j] = H[j, i] = -mixed / (2.0 * steps[i] * steps[j])
    cov = _inverse(H)
    if cov is None:
        # Without curvature at this width, the outer product is positive definite in any case.
        cov = np.linalg.inv(outer)
    return LikelihoodCurvature(cov, _widened(cov, scores, precision))


def _scaled(matrix: np.ndarray) -> np.ndarray:
    """Return a positive definite matrix (k, k) scaled to a diagonal of ones."""
    root = np.sqrt(np.diag(matrix))
    return matrix / np.outer(root, root)


def _inverse(H: np.ndarray) -> np.ndarray | None:
    """Return the inverse of a positive definite matrix; None for any other."""
    if not np.all(np.isfinite(H)) or np.any(np.diag(H) <= 0.0):
        return None
    root = np.sqrt(np.diag(H))
    values, vectors = np.linalg.eigh(_scaled(H))
    if values[0] <= MIN_CURVATURE * values[-1]:
        return None
    return (vectors / values) @ vectors.T / np.outer(root, root)


def _widened(cov: np.ndarray, scores: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Return the factor by which deviations of H⁻¹ J H⁻¹ exceed those of H⁻¹, (k,)."""
    sums = _batched(scores.T, SCORE_BATCHES)
    if len(sums) < SCORE_BATCHES:
        return np.ones(len(cov))
    J = sums.T @ sums * SCORE_BATCHES / (SCORE_BATCHES - 1.0) + np.diag(precision)
    robust = cov @ J @ cov
    return np.sqrt(np.maximum(1.0, np.diag(robust) / np.diag(cov)))


def intervals(
    objective: Objective, x: np.ndarray, value: float, shape: LikelihoodCurvature
) -> tuple[np.ndarray, np.ndarray]:
    """Return 95 % intervals (k, 2) on the scales of the fit, and the mask of those by profile (k,).

    Args:
        objective: The objective.
        x: Its maximum, (k,).
        value: Its value there.
        shape: Its curvature there.
    """
    low, high = objective.limits
    deviation = shape.deviation
    found = np.stack([x - Z * deviation, x + Z * deviation], axis=1)
    ends = [(i, side) for i in range(x.size) for side in (0, 1)]
    points = [objective.within(x + (found[i, side] - x[i]) * shape.lines[i]) for i, side in ends]
    dropped = [value - terms.sum() + objective.penalty(p) for p, terms in zip(points, objective.all_terms(points))]
    profiled = np.zeros(x.size, bool)
    loose = deviation > MIN_LOOSENESS * np.array([item.deviation for item in objective.entries])
    for i, side in ends:
        root = np.sqrt(max(0.0, 2.0 * dropped[2 * i + side])) / shape.widened[i]
        if abs(root - Z) > MAX_MISFIT * Z or not low[i] < found[i, side] < high[i]:
            profiled[i] = loose[i]
    H = np.linalg.inv(shape.cov)
    # Two points of each profile, with two gradients each.
    objective.progress.expect(int(profiled.sum()) * 8 * x.size * objective.folds)
    for i in np.flatnonzero(profiled).tolist():
        profiled[i] = not objective.progress.stop
        for side in (0, 1) if profiled[i] else ():
            found[i, side] = _profile_end(objective, x, value, shape, H, i, found[i, side])
    return np.clip(found, low[:, None], high[:, None]), profiled


def _profile_end(
    objective: Objective, x: np.ndarray, value: float, shape: LikelihoodCurvature, H: np.ndarray, i: int, t: float
) -> float:
    """Return where the profile of entry i has dropped, on the side of t."""
    low, high = objective.limits[:, i]
    t = float(np.clip(t, low, high))
    before, root_before = float(x[i]), 0.0
    for _ in range(MAX_SECANTS):
        if t == x[i]:
            break
        drop = value - _profile(objective, x, H, i, t)
        root = np.sqrt(max(0.0, 2.0 * drop)) / shape.widened[i]
        if abs(root - Z) < ROOT_TOLERANCE * Z or (root < Z and t in (low, high)):
            break
        slope = (root - root_before) / (t - before)
        # Where it is flat, or rises again: further out.
        after = t + (Z - root) / slope if slope * (t - x[i]) > 0.0 else np.inf * (t - x[i])
        ratio = float(np.clip((after - x[i]) / (t - x[i]), 0.2, 3.0))
        before, root_before, t = t, root, float(np.clip(x[i] + ratio * (t - x[i]), low, high))
    return t


def _profile(objective: Objective, x: np.ndarray, H: np.ndarray, i: int, t: float) -> float:
    """Return the maximum with entry i at t."""
    low, high = np.delete(objective.limits, i, axis=1)
    others = np.delete(np.arange(x.size), i)
    rest = objective.pinned([i], np.where(np.arange(x.size) == i, t, x))
    penalty = 0.5 * float(objective.precision[i] * (t - objective.start[i]) ** 2)
    if not others.size:
        return rest.value(np.zeros(0)) - penalty
    across = H[np.ix_(others, others)]
    start = np.clip(x[others] - np.linalg.solve(across, H[others, i]) * (t - x[i]), low, high)
    return quasi_newton(rest, start, across, steps=PROFILE_STEPS)[1] - penalty


WIDTH_STEP = 0.05  # Step of the differences, in deviations of the prior
WIDTH_BATCHES = (8, 20, 50)  # Numbers of batches of time; the one with the largest inflation counts
MIN_INFORMATION = 1e-9  # Share of the largest eigenvalue of G, in units of the prior, below which there is none


class ParameterWidths(NamedTuple):
    """Uncertainty of parameters after a fit, and where the data of that fit lie.

    `std` (k,) and `correlation` (k, k) are those of the parameters `names`, in their units; `prior` (k,) their
    deviations without data; `inflation` the factor τ by which correlated errors discount the information. `envelope`
    has the range of each input and shown state over the fitted events. `spread` (k,) are the deviations between
    specimens, of which each recording counts as another.
    """

    names: tuple[str, ...]
    std: np.ndarray
    correlation: np.ndarray
    prior: np.ndarray
    inflation: float
    envelope: Mapping[str, tuple[float, float]]
    spread: np.ndarray


def parameter_widths(
    estimator: str,
    setting: Setting,
    recordings: Sequence[Recording],
    prior: Mapping[str, float],
    *,
    aim: Aim,
    go: Go = lambda folds: True,
    executor: Executor | str | None = "threads",
) -> ParameterWidths:
    """Return the uncertainty of parameters of a tuning by recordings, 2 k + 1 folds of each.

    Args:
        estimator: The filter.
        setting: Tuning and prior of the state; the model considers no parameter.
        recordings: Recordings; held-out events take no part.
        prior: Standard deviation of each parameter without data, in its unit.
        aim: Aim of the fit: with `WITNESSES` the references take part.
        go: Callback, see `Go`.
        executor: Where they are folded, see `fit`.

    Raises:
        Cancelled: If `go` returns False.
    """
    model, names = setting.tuning.model, tuple(prior)
    known = {item.name: item for item in model.parameters}
    D = np.array([prior[name] for name in names])
    centre = np.array([float(setting.tuning.get(f"p.{name}") or 0.0) for name in names])
    ends = np.array([(known[name].low, known[name].high) for name in names], float).reshape(-1, 2)
    below, above = (np.clip(centre + sign * WIDTH_STEP * D, *ends.T) for sign in (-1.0, 1.0))
    points = [(name, value) for name, pair in zip(names, zip(below, above, strict=True), strict=True) for value in pair]
    items = [(k, point) for k in range(len(recordings)) for point in (None, *points)]
    work = partial(_residuals_at, estimator, setting, tuple(recordings), aim)
    folded = iter(each_folded(work, items, 1, estimator, model, executor=executor, go=go))
    values, slopes = [], []
    envelope: dict[str, tuple[float, float]] = {}
    for record in recordings:
        z, scale, ranges = next(folded)
        others = [next(folded)[0] for _ in points]
        columns = [(up - low) / (b - a) for low, up, a, b in zip(others[::2], others[1::2], below, above, strict=True)]
        Z = np.stack(columns, axis=-1) * D / scale[..., None] if names else np.zeros((*z.shape, 0))
        z = z / scale
        kept = np.isfinite(z) & np.all(np.isfinite(Z), axis=-1)
        root = np.sqrt(record.weight * _weights(z))
        values.append(np.where(kept, root * z, 0.0))
        slopes.append(np.where(kept[..., None], root[:, None] * Z, 0.0))
        for name, (low, high) in ranges.items():
            least, most = envelope.get(name, (np.inf, -np.inf))
            envelope[name] = min(least, low), max(most, high)
    cov, step, inflation = _posterior(values, slopes)
    cov = D[:, None] * (cov + np.outer(step, step)) * D
    std = np.sqrt(np.diag(cov))
    each, K = [_posterior([z], [Z]) for z, Z in zip(values, slopes, strict=True)], len(values)
    between, within = np.var([d for _, d, _ in each], axis=0), np.mean([np.diag(C) for C, *_ in each], axis=0)
    spread = D * np.sqrt(1 / K + between + (1 - 1 / K) * within)
    return ParameterWidths(names, std, _scaled(cov), D, inflation, envelope, spread)


def _posterior(values: Sequence[np.ndarray], slopes: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the covariance (k, k) and the step to the minimum (k,) with the prior, in its units, and τ."""
    G, information, score, inflation = _godambe(values, slopes)
    unit = np.eye(score.size)
    return np.linalg.inv(information + unit), np.linalg.solve(G / inflation + unit, score / inflation), inflation


def _residuals_at(
    estimator: str,
    setting: Setting,
    recordings: Sequence[Recording],
    aim: Aim,
    item: tuple[int, tuple[str, float] | None],
) -> tuple[np.ndarray, np.ndarray, dict[str, tuple[float, float]]]:
    """Return the residuals of recording k with a parameter at a value; for None, at the setting, its ranges, too.

    They are the errors of predictions at each event (n, rows), NaN where there is none, and their deviations. The
    columns are the rows of each sensor, then the references.
    """
    k, point = item
    record, tuning = recordings[k], setting.tuning
    if point is not None:
        tuning = tuning.set(f"p.{point[0]}", float(point[1]))
    track = track_of(estimator, setting._replace(tuning=tuning), record)
    model, log = tuning.model, record.log
    held = record.held_out if record.held_out.size else np.zeros(log.n, bool)
    errors, stds = [], []
    for s, sensor in enumerate(model.sensors):
        own = (track.verdict == USED) & ~held & (log.events.channel == s)
        rows = slice(0, len(sensor.rows))
        errors.append(np.where(own[:, None], track.innovation[:, rows], np.nan))
        stds.append(track.innovation_std[:, rows])
    for reference in references(model, log.events, track) if aim.kind == WITNESSES else ():
        error, std = np.full((2, log.n, 1), np.nan)
        error[reference.rows, 0], std[reference.rows, 0] = reference.error, reference.std
        error[held] = np.nan
        errors.append(error)
        stds.append(std)
    ranges = _ranges(model, log.events, track, ~held) if point is None else {}
    return np.concatenate(errors, axis=1), np.concatenate(stds, axis=1), ranges


def _weights(z: np.ndarray) -> np.ndarray:
    """Return the weight of each column of errors z (n, rows): independent ones per error.

    Scores are linear in the errors, so it is their own correlation that counts, and a bias is one error that lasts.
    """
    found = np.ones(z.shape[1])
    for k, column in enumerate(z.T):
        errors = column[np.isfinite(column)]
        if errors.size:
            most = MAX_ERROR * np.sqrt(np.mean(errors**2))
            found[k] = 1.0 / correlation_time(np.clip(errors, -most, most), about_mean=False)
    return found


def _ranges(model: StateSpaceModel, events: Events, track: Track, fitted: np.ndarray) -> dict[str, tuple[float, float]]:
    """Return the range of each shown state and input over the fitted events (n,) of a recording."""
    series = {state.name: track.mean[fitted, k] for k, state in enumerate(model.shown_states)}
    inputs = events.value[(events.kind == INPUT) & fitted]
    series |= {item.name: inputs[:, k] for k, item in enumerate(model.inputs)}
    finite = {name: column[np.isfinite(column)] for name, column in series.items()}
    return {name: (float(column.min()), float(column.max())) for name, column in finite.items() if column.size}


def _godambe(
    values: Sequence[np.ndarray], slopes: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return G, G J⁻¹ G (k, k), the score (k,) and the inflation τ, in units of the prior."""
    G = sum(np.einsum("nri,nrj->ij", Z, Z) for Z in slopes)
    each_score = [-np.einsum("nri,nr->ni", Z, z) for z, Z in zip(values, slopes, strict=True)]
    found, vectors = np.linalg.eigh(G)
    told = found > MIN_INFORMATION * max(float(found[-1]), 1.0) if found.size else np.zeros(0, bool)
    score = np.sum([s.sum(axis=0) for s in each_score], axis=0)
    if not told.any():
        return G, np.zeros_like(G), np.zeros_like(score), 1.0
    root = vectors[:, told] * np.sqrt(found[told])
    white = vectors[:, told] / np.sqrt(found[told])
    B, inflation = np.eye(int(told.sum())), 1.0
    for batches in WIDTH_BATCHES:
        sums = np.concatenate([_batched(s, batches) for s in each_score]) @ white
        outer = sums.T @ sums * len(sums) / max(1, len(sums) - 1)
        if np.trace(outer) / len(outer) > inflation:
            B, inflation = outer, float(np.trace(outer) / len(outer))
    sizes, axes = np.linalg.eigh(B)
    B = (axes * np.maximum(sizes, inflation)) @ axes.T
    return G, root @ np.linalg.inv(B) @ root.T, score, inflation


def _batched(scores: np.ndarray, batches: int) -> np.ndarray:
    """Return sums of scores (n, k) over batches of time, less their mean, (batches, k); one of zeros if n is small."""
    scored = scores[np.any(scores != 0.0, axis=1)]
    if len(scored) < 2 * batches:
        return np.zeros((1, scores.shape[1]))
    edges = np.linspace(0, len(scored), batches, endpoint=False).astype(int)
    sums: np.ndarray = np.add.reduceat(scored, edges, axis=0)
    return sums - sums.mean(axis=0)
