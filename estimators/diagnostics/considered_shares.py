"""Sources of the variance of a state: considered parameters, and noise."""

from __future__ import annotations

import numpy as np

from ..model.assemble import deviation, outside
from ..model.state_space import StateSpaceModel

NOISE = "noise"
"""What no considered parameter explains: noise of process and sensors, and the prior of the states."""


def considered_labels(model: StateSpaceModel) -> list[str]:
    """Return the names of the parameters behind the considered states, with "outside" for what their range adds."""
    names = model.state_names[model.nx - model.considered :]
    known = {deviation(item.name): item.name for item in model.parameters}
    known |= {outside(item.name): f"{item.name} outside" for item in model.parameters}
    return [known.get(name, name) for name in names]


def _considers(model: StateSpaceModel, cov: np.ndarray) -> bool:
    return model.considered > 0 and cov.shape[0] == model.nx and bool(np.isfinite(cov).all())


def variance_shares(model: StateSpaceModel, cov: np.ndarray) -> dict[str, dict[str, float]]:
    """Return for each estimated state the share of its variance by considered parameter, largest first, and `NOISE`.

    With G = P_xc C⁻¹, the sensitivity of the error of x to the deviations c, the variance is that of noise and
    (G C Gᵀ)_ii = Σ_j G_ij (P_xc)_ij, a term for each parameter: G_ij² C_jj of an independent one. Correlated parameters
    share their joint terms equally, so that one whose error cancels another's has a negative share.

    Source: Li et al. (2010), doi:10.1021/jp9096919, for shares of correlated inputs (structural and correlative).

    Args:
        model: A model with considered states.
        cov: Covariance of its states (nx, nx), as of `Fold.moments`.

    Returns:
        Nothing for a model without considered states; of a state only those with a positive, finite variance.
    """
    n = model.nx - model.considered
    if not _considers(model, cov):
        return {}
    C, cross = cov[n:, n:], cov[:n, n:]
    # In units of the deviations, so that small ones do not drown; members fewer than parameters leave C singular.
    unit = np.sqrt(np.diag(C))
    unit = np.where(unit > 0.0, unit, 1.0)
    terms = (cross / unit) @ np.linalg.pinv(C / np.outer(unit, unit), hermitian=True) / unit * cross
    labels = considered_labels(model)
    found = {}
    for i, name in enumerate(model.state_names[:n]):
        if cov[i, i] > 0.0:
            shares = sorted(zip(labels, (terms[i] / cov[i, i]).tolist(), strict=True), key=lambda item: -item[1])
            found[name] = {**dict(shares), NOISE: 1.0 - sum(share for _, share in shares)}
    return found


def known_stds(model: StateSpaceModel, cov: np.ndarray) -> dict[str, dict[str, float]]:
    """Return for each estimated state its deviation if one considered parameter were measured exactly, smallest first.

    Conditioned on c_j the variance is P_ii - (P_xc)_ij² / C_jj, whatever the correlations of the parameters. The gain
    is that of the past: a filter that had known c_j from the start may be better still. Arguments, and states without
    a result, are those of `variance_shares`.
    """
    n = model.nx - model.considered
    if not _considers(model, cov):
        return {}
    variance, labels = np.diag(cov), considered_labels(model)
    gained = np.divide(cov[:n, n:] ** 2, variance[n:], out=np.zeros((n, model.considered)), where=variance[n:] > 0.0)
    left = np.sqrt(np.maximum(variance[:n, None] - gained, 0.0))
    return {
        name: dict(sorted(zip(labels, left[i].tolist(), strict=True), key=lambda item: item[1]))
        for i, name in enumerate(model.state_names[:n])
        if variance[i] > 0.0
    }


MAX_PAIRS = 128
"""Pairs of a state and a deviation whose covariance is kept at most, 8 bytes an event each."""


def noise_states(model: StateSpaceModel) -> int:
    """Return the number of shown states, the first ones, whose covariances with the deviations are kept."""
    return min(len(model.shown), MAX_PAIRS // model.considered) if model.considered else 0


def considered_pairs(model: StateSpaceModel) -> np.ndarray:
    """Return the pairs (k, 2) of each of these states with each considered deviation, for `noise_std`."""
    states = model.shown[: noise_states(model)].tolist()
    every = [(j, model.nx - model.considered + c) for j in states for c in range(model.considered)]
    return np.array(every, int).reshape(-1, 2)


def noise_std(model: StateSpaceModel, shown: int, std: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Return the deviation (N,) that a shown state would have without its considered parameters; see `variance_shares`.

    Args:
        model: A model with considered states.
        shown: Index of the state among the shown ones, below `noise_states`.
        std: Deviations of the shown states (N, shown).
        cross: Covariances of a fold's pairs (N, pairs), the last of which are `considered_pairs`.

    Returns:
        NaN where the fold kept no covariances with the deviations.
    """
    first = cross.shape[1] - (noise_states(model) - shown) * model.considered
    if first < shown * model.considered:
        return np.full(len(std), np.nan)
    C = model.prior_cov[model.nx - model.considered :, model.nx - model.considered :]
    unit = np.sqrt(np.diag(C))
    own = cross[:, first : first + model.considered] / unit
    whitened = np.linalg.pinv(C / np.outer(unit, unit), hermitian=True)
    return np.sqrt(np.maximum(std[:, shown] ** 2 - np.einsum("ni,ij,nj->n", own, whitened, own), 0.0))


MIN_SHARE = 0.005
"""Share of a variance below which a parameter is not named."""


def source_texts(model: StateSpaceModel, cov: np.ndarray) -> dict[str, tuple[str, str]]:
    """Return for each estimated state the sources of its variance, and the gain of measuring one of them, as text.

    The gain is that of the parameter that reduces σ most: "capacity: σ 0.021 to 0.013".
    """
    known, found = known_stds(model, cov), {}
    for name, shares in variance_shares(model, cov).items():
        std = float(np.sqrt(cov[(k := model.state_names.index(name)), k]))
        label, left = next(iter(known[name].items()))
        gain = f"{label}: σ {std:.2g} to {left:.2g}" if left < (1.0 - MIN_SHARE) * std else "no parameter reduces σ"
        named = sorted(((k, v) for k, v in shares.items() if abs(v) >= MIN_SHARE), key=lambda item: -item[1])
        found[name] = ", ".join(f"{source} {100 * share:.0f} %" for source, share in named), gain
    return found
