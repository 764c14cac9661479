"""Shapes and numbers for the scene: ellipsoids of a covariance, polylines, round ticks."""

from __future__ import annotations

import numpy as np


def ellipsoid(cov: np.ndarray, sigmas: float = 2.0) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """The ellipsoid x' cov⁻¹ x = sigmas² as a unit sphere, scaled and turned.

    Args:
        cov: Symmetric positive semidefinite, shape (3, 3).
        sigmas: Mahalanobis distance of its surface.

    Returns:
        Lengths of the half axes (3,), and the unit quaternion (w, x, y, z) that turns the axes into place.
    """
    values, vectors = np.linalg.eigh(cov)
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] = -vectors[:, 0]
    return sigmas * np.sqrt(np.maximum(values, 0.0)), quaternion(vectors)


def quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """The unit quaternion (w, x, y, z) of a rotation matrix, from its largest component, which is never near zero.

    Source: Shepperd (1978), doi:10.2514/3.55767b.
    """
    m = rotation
    trace = np.trace(m)
    k = int(np.argmax([trace, m[0, 0], m[1, 1], m[2, 2]]))
    if k == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        a, b, c = (k - 1, k % 3, (k + 1) % 3)
        q = np.zeros(4)
        q[0] = m[c, b] - m[b, c]
        q[1 + a] = 1 + m[a, a] - m[b, b] - m[c, c]
        q[1 + b] = m[a, b] + m[b, a]
        q[1 + c] = m[a, c] + m[c, a]
    w, x, y, z = q / np.linalg.norm(q)
    return float(w), float(x), float(y), float(z)


def about_z(angle: float) -> tuple[float, float, float, float]:
    """The quaternion of a turn to the left about the vertical, in radians."""
    return float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2))


def segments(points: np.ndarray) -> np.ndarray:
    """A polyline (n, 3) as segments (n - 1, 2, 3); the gaps at rows that are not finite stay open."""
    pairs = np.stack((points[:-1], points[1:]), axis=1) if len(points) > 1 else np.zeros((0, 2, 3))
    pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))]
    # Viser draws nothing sensible of an empty array; a segment without length is invisible.
    return pairs.astype(np.float32) if len(pairs) else np.zeros((1, 2, 3), np.float32)


def disc(sides: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """A flat disc of radius 1 in the plane z = 0: vertices and triangles."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    rim = np.stack((np.cos(angle), np.sin(angle), np.zeros(sides)), axis=1)
    k = np.arange(sides)
    faces = np.stack((np.full(sides, sides), k, (k + 1) % sides), axis=1)
    return np.vstack((rim, np.zeros(3))).astype(np.float32), faces.astype(np.uint32)


def circle(sides: int = 64) -> np.ndarray:
    """The rim of that disc as segments (sides, 2, 3)."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    return segments(np.stack((np.cos(angle), np.sin(angle), np.zeros(sides + 1)), axis=1))


def round_step(span: float) -> float:
    """The smallest of 1, 2, 5 · 10ᵏ that is at least `span`."""
    exponent = np.floor(np.log10(span))
    for factor in (1.0, 2.0, 5.0, 10.0):
        step = factor * 10.0**exponent
        if step >= span * (1 - 1e-9):
            return float(step)
    return float(10.0 ** (exponent + 1))


def tick_text(value: float, step: float) -> str:
    """A tick's number with the decimals that its step needs."""
    if step < 1e-4 or abs(value) >= 1e6:
        return f"{value:.4g}"
    decimals = max(0, int(-np.floor(np.log10(step) + 1e-9)))
    return f"{value + 0.0:.{decimals}f}"


def with_deviation(value: float, deviation: float) -> str:
    """A value with its deviation, to one decimal or two digits of the deviation, as the page writes them."""
    if not deviation > 0 or not np.isfinite(deviation):
        return f"{value:.4g}"
    decimals = min(8, max(1, int(1 - np.floor(np.log10(deviation)))))
    return f"{value + 0.0:.{decimals}f} ± {deviation:.{decimals}f}"
