"""The tangent plane against the radii of curvature near its origin, and against true distances far from it."""

import numpy as np
import pytest

from sources.mapping import ECCENTRICITY2, SEMI_MAJOR, east_north


@pytest.mark.parametrize("latitude", [-80.0, -33.0, 0.0, 37.7, 56.0, 85.0])
def test_near_the_origin_it_is_the_radii_of_curvature(latitude):
    """Meridian M and prime vertical N; second-order terms are d²/R, 2e-3 mm for 3 m."""
    phi = np.radians(latitude)
    root = np.sqrt(1 - ECCENTRICITY2 * np.sin(phi) ** 2)
    M, N = SEMI_MAJOR * (1 - ECCENTRICITY2) / root**3, SEMI_MAJOR / root
    step = 3e-5
    got = east_north(np.array([[latitude + step, 12.0], [latitude, 12.0 + step]]), (latitude, 12.0))
    d = np.radians(step)
    assert got[0] == pytest.approx([0.0, d * M], abs=1e-5)
    assert got[1] == pytest.approx([d * N * np.cos(phi), 0.0], abs=2e-5 * max(1.0, abs(np.tan(phi))))


def test_far_from_the_origin_lengths_stay_true():
    """Two points 20 km north of the origin and 100 m apart, east to west: radii at the origin would be 0.5 % off."""
    phi = np.radians(56.18)
    N = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(phi) ** 2)
    step = np.degrees(100.0 / (N * np.cos(phi)))
    a, b = east_north(np.array([[56.18, 10.0], [56.18, 10.0 + step]]), (56.0, 10.0))
    assert np.hypot(*(b - a)) == pytest.approx(100.0, rel=1e-5)


@pytest.mark.parametrize("metres", [1e3, 40e3])
def test_distances_are_short_by_a_sixth_of_the_square_of_the_angle(metres):
    """Along the equator, a circle of radius a: R sin θ instead of R θ."""
    theta = metres / SEMI_MAJOR
    (east, north), = east_north(np.array([[0.0, 10.0 + np.degrees(theta)]]), (0.0, 10.0))  # fmt: skip
    assert east == pytest.approx(SEMI_MAJOR * np.sin(theta), abs=1e-6) and north == pytest.approx(0.0, abs=1e-9)
    assert metres - east == pytest.approx(metres * theta**2 / 6, rel=1e-3, abs=1e-7)


def test_what_is_no_position_is_missing():
    got = east_north(np.array([[91.0, 0.0], [0.0, 181.0], [np.nan, 0.0], [1.0, 1.0]]), (0.0, 0.0))
    assert np.isnan(got[:3]).all() and np.isfinite(got[3]).all()


def test_the_ellipsoid_is_wgs84():
    """Its derived constants as NIMA TR8350.2 gives them: semi-minor axis, first eccentricity squared."""
    assert SEMI_MAJOR * np.sqrt(1 - ECCENTRICITY2) == pytest.approx(6356752.3142, abs=1e-4)
    assert ECCENTRICITY2 == pytest.approx(6.69437999014e-3, rel=1e-11)
