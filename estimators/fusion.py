"""Fusion of two estimates of one asset whose errors are correlated in an unknown way.

Two twins that use the same measurements, or the same model, have correlated errors. To add their information would
count the shared part twice, and the result would be overconfident. Covariance intersection is consistent whatever the
correlation, if both estimates are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from .errors import EstimatorError, nearest
from .numerics.linalg import wrapped

BISECTIONS = 60
"""Halvings of the interval of the weight: to the last bit."""

Message: TypeAlias = Mapping[str, Any]  # State message of /api/state, as a dictionary


def covariance_intersection(
    means: np.ndarray, covs: np.ndarray, minimise: Literal["det", "trace"] = "det"
) -> tuple[np.ndarray, np.ndarray, float]:
    """Fuse two estimates of the same quantities with unknown correlation.

        P^-1 = w P1^-1 + (1 - w) P2^-1;  x = P (w P1^-1 x1 + (1 - w) P2^-1 x2)

    P is at least the covariance of the error of x for every correlation of the errors of x1 and x2. With P1 = P2 it is
    P1, as the same estimate twice has no more information than once.

    Args:
        means: Two means, shape (2, n); circular quantities within π of each other.
        covs: Their covariances, shape (2, n, n), positive definite.
        minimise: "det" chooses w for the least determinant of P, whatever the units; "trace" for the least sum of
            variances, for quantities of one unit.

    Returns:
        Mean x (n,), covariance P (n, n), and the weight w of the first estimate, 0 to 1.

    Raises:
        EstimatorError: If shapes differ, or a covariance is not positive definite.

    Source: Julier & Uhlmann (1997), A non-divergent estimation algorithm in the presence of unknown correlations,
    doi:10.1109/ACC.1997.609105.
    """
    x, P = np.asarray(means, float), np.asarray(covs, float)
    if x.ndim != 2 or len(x) != 2 or x.shape[1] == 0 or P.shape != (*x.shape, x.shape[1]):
        raise EstimatorError(
            f"means has shape {x.shape} and covs {P.shape}; they must be (2, n) and (2, n, n), n at least 1"
        )
    if minimise not in ("det", "trace"):
        raise EstimatorError(f"minimise is {minimise!r}; it must be 'det' or 'trace'")
    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        raise EstimatorError("means and covs must be finite: fuse valid estimates only")
    for k in range(2):
        if not np.allclose(P[k], P[k].T, rtol=1e-9, atol=0.0) or np.linalg.eigvalsh(P[k])[0] <= 0.0:
            raise EstimatorError(
                f"covs[{k}] is not symmetric and positive definite; leave out states that are known exactly"
            )
    # With P1 = T Tᵀ and P2 = T diag(e) Tᵀ, P = T diag(e / (w e + 1 - w)) Tᵀ.
    L = np.linalg.cholesky(P[0])
    half = np.linalg.solve(L, P[1])
    e, V = np.linalg.eigh(np.linalg.solve(L, half.T))
    T = L @ V
    share = np.sum(T * T, axis=0) * e if minimise == "trace" else np.ones(e.size)
    w = _weight(e, share, 2 if minimise == "trace" else 1)
    scale = e / (w * e + 1.0 - w)
    # x = x2 + w P P1⁻¹ (x1 - x2)
    mean = x[1] + T @ (w * scale * np.linalg.solve(T, x[0] - x[1]))
    return mean, (T * scale) @ T.T, w


def _weight(e: np.ndarray, share: np.ndarray, power: int) -> float:
    """Return the w at which Σ share (1 - e) / (w e + 1 - w)^power, the slope of a convex function, changes its sign."""
    if np.all(np.abs(e - 1.0) < 1e-9):
        return 0.5
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        w = 0.5 * (low + high)
        if np.sum(share * (1.0 - e) / (w * e + 1.0 - w) ** power) < 0.0:
            low = w
        else:
            high = w
    return 0.0 if low == 0.0 else 1.0 if high == 1.0 else 0.5 * (low + high)


@dataclass(frozen=True)
class Fused:
    """Two estimates of one asset as one.

    `states` are the shared states with their `units`; `mean` (n,) and `cov` (n, n) the fused estimate at `time_ns`, and
    `weight` the share of the first. `difference` (n,) is the first mean minus the second, `bound` (n,) twice the sum of
    both standard deviations: a difference beyond it contradicts at least one of the two bands, whatever their
    correlation.
    """

    time_ns: int
    states: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    cov: np.ndarray
    weight: float
    difference: np.ndarray
    bound: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (n,)."""
        return np.sqrt(np.diag(self.cov))

    @property
    def agrees(self) -> bool:
        """Whether no difference is beyond its bound; otherwise the fused estimate is not valid either."""
        return bool(np.all(np.abs(self.difference) <= self.bound))


def fuse(
    first: Message,
    second: Message,
    *,
    same: Mapping[str, str] | None = None,
    within: float = 0.0,
    circular: Collection[str] = (),
    minimise: Literal["det", "trace"] = "det",
) -> Fused:
    """Fuse the state messages of two twins of one asset by covariance intersection.

    Args:
        first: Message of `/api/state?covariance=true`, as a dictionary.
        second: The same of the other twin.
        same: Names of states of the first, with the names that they have in the second; None for all states of equal
            name and unit.
        within: Seconds by which the times of both may differ; the older estimate then counts as one of the newer time,
            so the states must change by far less than a standard deviation in this time.
        circular: States of the first that are angles, rad.
        minimise: See `covariance_intersection`.

    Raises:
        EstimatorError: If no state is shared, a state is not valid, units differ, a covariance is missing, or the times
            differ by more than `within`.
    """
    a, b = _Message(first, "first"), _Message(second, "second")
    pairs = dict(same) if same is not None else {n: n for n in a.states if b.states.get(n, {}).get("unit") == a.unit(n)}
    if not pairs:
        raise EstimatorError(
            f"{a.label} and {b.label} share no state of equal name and unit: {', '.join(a.states)}; "
            f"{', '.join(b.states)}. Name the pairs: same={{'state of the first': 'state of the second'}}"
        )
    for name in circular:
        if name not in pairs:
            raise EstimatorError(f"circular names {name!r}, which is not shared; {nearest(name, pairs)}")
    for mine, theirs in pairs.items():
        if a.unit(mine) != b.unit(theirs):
            raise EstimatorError(
                f"{mine} of {a.label} is in {a.unit(mine) or '1'} and {theirs} of {b.label} in "
                f"{b.unit(theirs) or '1'}; shared states must have one unit"
            )
    x1, P1 = a.moments(list(pairs))
    x2, P2 = b.moments(list(pairs.values()))
    gap = abs(a.time_ns - b.time_ns) * 1e-9
    if gap > within:
        raise EstimatorError(
            f"{a.label} and {b.label} are estimates of times {gap:.3g} s apart, limit {within:g} s; fuse messages of "
            "equal time_ns, or give a larger `within`"
        )
    turning = np.array([name in circular for name in pairs])
    difference = wrapped(x1 - x2, turning)
    mean, cov, weight = covariance_intersection(np.stack((x2 + difference, x2)), np.stack((P1, P2)), minimise)
    return Fused(
        time_ns=max(a.time_ns, b.time_ns),
        states=tuple(pairs),
        units=tuple(a.unit(name) for name in pairs),
        mean=wrapped(mean, turning),
        cov=cov,
        weight=weight,
        difference=difference,
        bound=2.0 * (np.sqrt(np.diag(P1)) + np.sqrt(np.diag(P2))),
    )


class _Message:
    """A state message, read by the names of its states."""

    def __init__(self, message: Message, which: str) -> None:
        version = message.get("version") if isinstance(message, Mapping) else None
        if version != "nisus.state/1":
            raise EstimatorError(
                f"the {which} message has version {version!r}; it must be nisus.state/1, of /api/state"
            )
        self.label = f"the {which} message ({message['twin']})"
        self.states = {item["name"]: item for item in message["states"]}
        self.time_ns: int = message["time_ns"] or 0
        self._message = message

    def unit(self, name: str) -> str:
        """Return the unit of a state."""
        if name not in self.states:
            raise EstimatorError(f"{self.label} has no state {name!r}; {nearest(name, self.states)}")
        return str(self.states[name]["unit"])

    def moments(self, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (n,) and covariance (n, n) of states."""
        for name in names:
            if not self.states[name]["valid"]:
                raise EstimatorError(f"{self.label}: {name} is not valid ({self.states[name]['reason']})")
        mean = np.array([self.states[name]["value"] for name in names], float)
        order, cov = self._message["covariance_of"], self._message["covariance"]
        if cov is None and len(names) == 1:
            return mean, np.array([[float(self.states[names[0]]["std"]) ** 2]])
        if cov is None:
            raise EstimatorError(f"{self.label} has no covariance; ask for /api/state?covariance=true")
        rows = [order.index(name) for name in names]
        return mean, np.array(cov, float)[np.ix_(rows, rows)]
