"""Learned corrections of the rates of some states, with the remaining share of their variance.

A correction is trained on windows of recordings: their features z (d of the model's states and inputs), and the errors
r of the model's rates in them, in units of the state a second. It gives the correction m(z), and s(z) from 0 to 1: the
remaining variance relative to that without data. Far from its windows m → 0 and s → 1, which leaves the physics.

Gaussian process, the prior variance being 1 for all corrected states:

    κᵢ = exp(-½ Σⱼ ((zⱼ - Zᵢⱼ) / ℓⱼ)²),   m = κᵀ (K + ρ I)⁻¹ r,   s = 1 - κᵀ (K + ρ I)⁻¹ κ

Ridge, over φ = (1, z, and for degree 2 all zᵢ zⱼ) of standardised features, where D is the Mahalanobis distance from
the windows and g = exp(-½ max(0, D - reach)²) its weight there:

    m = g φᵀ A⁻¹ Φᵀ r,   A = ΦᵀΦ + λ I,   s = 1 - g (1 - min(1, λ φᵀ A⁻¹ φ / mean |Φ|²))

A pretrained net gives m itself, with the weight of ridge: m = g·net(z), s = 1 - g.

Sources: Rasmussen & Williams (2006), Gaussian Processes for Machine Learning, (2.25), (2.26), and 2.1.1 for ridge as
a Bayesian regression; Ko & Fox (2009), GP-BayesFilters, doi:10.1007/s10514-009-9119-x, for Q of x from s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

FEATURE_JITTER = 0.01
"""Added to the diagonal of a correlation of features, so that equal features do not make it singular."""


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """A Gaussian process over points (M, d) at which the rates (M, k) were, with length scales (d,), and ρ, `ratio`.

    ρ is the variance that a window has beside the correction, over that of the correction.
    """

    points: np.ndarray
    rates: np.ndarray
    lengths: np.ndarray
    ratio: float

    @cached_property
    def data(self) -> tuple[np.ndarray, ...]:
        """Data of the compiled functions: Z / ℓ, 1 / ℓ, weights (M, k), and L⁻¹ (M, M) with L Lᵀ = K + ρ I."""
        scaled = np.ascontiguousarray(self.points / self.lengths)
        K = self._near(self.points) + self.ratio * np.eye(len(scaled))
        L = np.linalg.cholesky(K)
        weights = cho_solve((L, True), self.rates)
        root = solve_triangular(L, np.eye(len(K)), lower=True)
        return scaled, 1.0 / self.lengths, np.ascontiguousarray(weights), np.ascontiguousarray(root)

    def _near(self, z: np.ndarray) -> np.ndarray:
        """Return κ (N, M) of features z (N, d)."""
        off = z[:, None, :] / self.lengths - self.points / self.lengths
        return np.exp(-0.5 * np.sum(off**2, axis=-1))

    def mean(self, z: np.ndarray) -> np.ndarray:
        """Return m (N, k) at features z (N, d)."""
        return self._near(z) @ self.data[2]

    def share(self, z: np.ndarray) -> np.ndarray:
        """Return s (N,) at features z (N, d)."""
        explained = np.sum((self._near(z) @ self.data[3].T) ** 2, axis=1)
        return np.clip(1.0 - explained, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Ridge:
    """Ridge regression on points (M, d) at which the rates (M, k) were, with the penalty λ, of degree 1 or 2."""

    points: np.ndarray
    rates: np.ndarray
    penalty: float
    degree: int = 1

    @cached_property
    def terms(self) -> np.ndarray:
        """Of each entry of φ the features that it is the product of, (n, 2); -1 for none."""
        d = self.points.shape[1]
        pairs = [(-1, -1), *((i, -1) for i in range(d))]
        if self.degree > 1:
            pairs += [(i, j) for i in range(d) for j in range(i, d)]
        return np.array(pairs, np.int64)

    @cached_property
    def data(self) -> tuple[np.ndarray, ...]:
        """Data of the compiled functions: `support`, terms, weights (n, k), and C (n, n): s = 1 - g (1 - φᵀCφ)."""
        centre, scale, precision, reach = support(self.points)
        phi = self._phi((self.points - centre) / scale)
        A = phi.T @ phi + self.penalty * np.eye(phi.shape[1])
        L = np.linalg.cholesky(A)
        inverse = cho_solve((L, True), np.eye(len(A)))
        C = self.penalty * inverse / np.mean(np.sum(phi**2, axis=1))
        return centre, scale, precision, reach, self.terms, cho_solve((L, True), phi.T @ self.rates), C

    def _phi(self, z: np.ndarray) -> np.ndarray:
        whole = np.concatenate((z, np.ones((len(z), 1))), axis=1)  # the last column, at -1, is 1
        return whole[:, self.terms[:, 0]] * whole[:, self.terms[:, 1]]

    def mean(self, z: np.ndarray) -> np.ndarray:
        """Return m (N, k) at features z (N, d)."""
        centre, scale, _, _, _, weights, _ = self.data
        return weight(z, self.data)[:, None] * (self._phi((z - centre) / scale) @ weights)

    def share(self, z: np.ndarray) -> np.ndarray:
        """Return s (N,) at features z (N, d)."""
        centre, scale, *_, C = self.data
        phi = self._phi((z - centre) / scale)
        left = np.minimum(1.0, np.einsum("ni,ij,nj->n", phi, C, phi))
        return 1.0 - weight(z, self.data) * (1.0 - left)


@dataclass(frozen=True, eq=False)
class Net:
    """A function of features (N, d) that gives rates (N, k), weighted by the distance from the points (M, d).

    It is not compiled, so the model that it corrects becomes a black box.
    """

    points: np.ndarray
    run: Callable[[np.ndarray], np.ndarray]

    @cached_property
    def data(self) -> tuple[np.ndarray, ...]:
        """Data of the compiled function, see `support`."""
        return support(self.points)

    def mean(self, z: np.ndarray) -> np.ndarray:
        """Return m (N, k) at features z (N, d)."""
        return weight(z, self.data)[:, None] * self.run(z)

    def share(self, z: np.ndarray) -> np.ndarray:
        """Return s (N,) at features z (N, d)."""
        return 1.0 - weight(z, self.data)


Correction = GaussianProcess | Ridge | Net


def support(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return centre and scale (d,), inverse correlation (d, d) and greatest distance (1,) of points (M, d)."""
    centre, scale = points.mean(axis=0), points.std(axis=0)
    z = (points - centre) / scale
    d = points.shape[1]
    precision = np.linalg.inv(z.T @ z / len(z) + FEATURE_JITTER * np.eye(d))
    reach = np.sqrt(np.max(np.einsum("ni,ij,nj->n", z, precision, z)))
    return centre, scale, precision, np.array([reach])


def weight(z: np.ndarray, data: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return g (N,) at features z (N, d), for a support."""
    centre, scale, precision, reach = data[:4]
    off = (z - centre) / scale
    beyond = np.maximum(0.0, np.sqrt(np.einsum("ni,ij,nj->n", off, precision, off)) - reach[0])
    return np.exp(-0.5 * beyond**2)


def _feature(x, u, place):
    """Return a feature, of the type of x."""
    return x[place] if place >= 0 else u[-1 - place] + 0.0 * x[0]


def _nearness(x, u, place, point, inverse):
    """Return κ of one window."""
    square = 0.0 * x[0]
    for j in range(place.size):
        off = _feature(x, u, place[j]) * inverse[j] - point[j]
        square += off * off
    return np.exp(-0.5 * square)


def process_add(x, u, dt, place, target, data, out):
    """out[target] += dt m."""
    scaled, inverse, weights, _ = data
    for i in range(scaled.shape[0]):
        near = _nearness(x, u, place, scaled[i], inverse)
        for c in range(target.size):
            out[target[c]] += dt * near * weights[i, c]


def process_slope(x, u, dt, place, target, data, out):
    """out[target, :] += dt ∂m/∂x."""
    scaled, inverse, weights, _ = data
    for i in range(scaled.shape[0]):
        near = _nearness(x, u, place, scaled[i], inverse)
        for j in range(place.size):
            if place[j] >= 0:
                fall = -(x[place[j]] * inverse[j] - scaled[i, j]) * inverse[j] * near * dt
                for c in range(target.size):
                    out[target[c], place[j]] += fall * weights[i, c]


def process_share(x, u, place, data):
    """s."""
    scaled, inverse, _, root = data
    n = scaled.shape[0]
    near = np.empty(n)
    for i in range(n):
        near[i] = _nearness(x, u, place, scaled[i], inverse)
    left = 1.0
    for i in range(n):
        part = 0.0
        for j in range(i + 1):
            part += root[i, j] * near[j]
        left -= part * part
    return min(1.0, max(0.0, left))


def _standard(x, u, place, data, z):
    """z = the standardised features; returns D."""
    centre, scale, precision = data[0], data[1], data[2]
    for j in range(place.size):
        z[j] = (_feature(x, u, place[j]) - centre[j]) / scale[j]
    square = 0.0 * x[0]
    for i in range(z.size):
        for j in range(z.size):
            square += z[i] * precision[i, j] * z[j]
    return np.sqrt(square)


def _weight(distance, reach):
    """g of a distance D."""
    beyond = distance - reach
    if beyond.real <= 0.0:
        beyond = 0.0 * distance
    return np.exp(-0.5 * beyond * beyond)


def _term(z, pair, factor):
    """Return one entry of φ times `factor`."""
    value = factor
    if pair[0] >= 0:
        value = value * z[pair[0]]
    if pair[1] >= 0:
        value = value * z[pair[1]]
    return value


def ridge_add(x, u, dt, place, target, data, out):
    """out[target] += dt m."""
    _, _, _, reach, terms, weights, _ = data
    z = np.empty(place.size, x.dtype)
    g = _weight(_standard(x, u, place, data, z), reach[0])
    for i in range(terms.shape[0]):
        term = _term(z, terms[i], g)
        for c in range(target.size):
            out[target[c]] += dt * term * weights[i, c]


def ridge_slope(x, u, dt, place, target, data, out):
    """out[target, :] += dt ∂m/∂x."""
    _, scale, precision, reach, terms, weights, _ = data
    z = np.empty(place.size)
    distance = _standard(x, u, place, data, z)
    g = _weight(distance, reach[0])
    for j in range(place.size):
        if place[j] < 0:
            continue
        turned = 0.0
        for i in range(place.size):
            turned += precision[j, i] * z[i]
        fading = -max(0.0, distance - reach[0]) * turned / distance if distance > 0.0 else 0.0
        for i in range(terms.shape[0]):
            a, b = terms[i, 0], terms[i, 1]
            slope = fading * _term(z, terms[i], 1.0)
            if a == j:
                slope += z[b] if b >= 0 else 1.0
            if b == j:
                slope += z[a]
            for c in range(target.size):
                out[target[c], place[j]] += dt * g * slope / scale[j] * weights[i, c]


def ridge_share(x, u, place, data):
    """s."""
    _, _, _, reach, terms, _, C = data
    z = np.empty(place.size)
    g = _weight(_standard(x, u, place, data, z), reach[0])
    left = 0.0
    for i in range(terms.shape[0]):
        row = _term(z, terms[i], 1.0)
        for j in range(terms.shape[0]):
            left += row * C[i, j] * _term(z, terms[j], 1.0)
    return 1.0 - g * (1.0 - min(1.0, left))


def net_share(x, u, place, data):
    """s."""
    z = np.empty(place.size)
    return 1.0 - _weight(_standard(x, u, place, data, z), data[3][0])


FUNCTIONS: dict[type, tuple[Callable | None, Callable | None, Callable]] = {
    GaussianProcess: (process_add, process_slope, process_share),
    Ridge: (ridge_add, ridge_slope, ridge_share),
    Net: (None, None, net_share),
}
"""Plain functions to compile, by kind of correction: they add m, add its slope, and return s."""
