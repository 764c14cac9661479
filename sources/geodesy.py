"""Latitude and longitude to metres east and north."""

from __future__ import annotations

import numpy as np

SEMI_MAJOR = 6378137.0
"""WGS84, m."""
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def _earth_fixed(latitude: np.ndarray, longitude: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the ellipsoid; angles in radians."""
    normal = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    x = normal * np.cos(latitude) * np.cos(longitude)
    y = normal * np.cos(latitude) * np.sin(longitude)
    return x, y, normal * (1 - ECCENTRICITY2) * np.sin(latitude)


def east_north(fixes: np.ndarray, origin: tuple[float, float]) -> np.ndarray:
    """Metres east and north of the origin, in the plane that touches the WGS84 ellipsoid there.

    N = a / √(1 - e² sin²φ);  r = (N cosφ cosλ, N cosφ sinλ, N (1 - e²) sinφ);
    east = -sinλ₀ dx + cosλ₀ dy;  north = -sinφ₀ cosλ₀ dx - sinφ₀ sinλ₀ dy + cosφ₀ dz,  (dx, dy, dz) = r - r₀

    A point at the distance d over ground appears short by d (d/R)²/6: 4 μm at 1 km, 0.26 m at 40 km. Scaling the angles
    by the radii of curvature at the origin is true at the origin only: its east is wrong by 0.5 % when 20 km north of
    it at 56° latitude.

    Args:
        fixes: Latitude and longitude, degrees, shape (n, 2). NaN, or what is no latitude or longitude, gives NaN.
        origin: Latitude and longitude, degrees.

    Source: NIMA TR8350.2 (2000), section 4; Groves (2013), Principles of GNSS, equations 2.112 and 2.150.
    """
    valid = (np.abs(fixes[:, 0]) <= 90) & (np.abs(fixes[:, 1]) <= 180)
    latitude, longitude = np.radians(np.where(valid, fixes.T, np.nan))
    lat0, lon0 = np.radians(np.asarray(origin, float))
    dx, dy, dz = (a - b for a, b in zip(_earth_fixed(latitude, longitude), _earth_fixed(lat0, lon0), strict=True))
    east = -np.sin(lon0) * dx + np.cos(lon0) * dy
    north = -np.sin(lat0) * (np.cos(lon0) * dx + np.sin(lon0) * dy) + np.cos(lat0) * dz
    return np.column_stack((east, north))
