"""What Viser's scenes compute before they draw: ellipsoids, ticks, where cameras stand, the sliding history."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.charts.colors import round_step, tick_text
from app.scene.scene import MARGIN, History, Outlook, ellipsoid, place, quaternion, segments
from app.scene.vehicle_scene import where_known, without_jumps


def rotation_of(q):
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


@pytest.mark.parametrize("seed", range(8))
def test_ellipsoid_surface_is_two_sigma(seed):
    """Every point of the scaled, turned unit sphere has Mahalanobis distance 2."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * [1.0, 0.1, 5.0]
    cov = root @ root.T
    half, turn = ellipsoid(cov)
    sphere = rng.normal(size=(100, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    surface = (sphere * half) @ rotation_of(turn).T
    distance = np.sqrt(np.einsum("ni,ij,nj->n", surface, np.linalg.inv(cov), surface))
    np.testing.assert_allclose(distance, 2.0, rtol=1e-6)
    np.testing.assert_allclose(np.sort(half), 2 * np.sqrt(np.linalg.eigvalsh(cov)), rtol=1e-9)


def test_ellipsoid_of_a_singular_covariance_is_flat():
    half, _ = ellipsoid(np.diag([4.0, 0.0, 1.0]))
    np.testing.assert_allclose(half, [0.0, 2.0, 4.0], atol=1e-12)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0.3, -2, 1]])
def test_quaternion_of_half_turns(axis):
    """Half turns have w = 0, where the textbook formula divides by zero."""
    n = np.array(axis, float) / np.linalg.norm(axis)
    matrix = 2 * np.outer(n, n) - np.eye(3)
    np.testing.assert_allclose(rotation_of(quaternion(matrix)), matrix, atol=1e-12)


@pytest.mark.parametrize(("span", "step"), [(0.9, 1.0), (1.0, 1.0), (1.1, 2.0), (0.021, 0.05), (510.0, 1000.0)])
def test_round_step(span, step):
    assert round_step(span) == pytest.approx(step)


@pytest.mark.parametrize(("value", "step", "text"), [(36.0, 2.0, "36"), (-0.5, 0.5, "-0.5"), (0.15, 0.05, "0.15")])
def test_tick_text(value, step, text):
    assert tick_text(value, step) == text


def test_segments_leave_gaps_open():
    points = np.array([[0, 0, 0], [1, 0, 0], [np.nan, 0, 0], [3, 0, 0], [4, 0, 0]], float)
    np.testing.assert_array_equal(segments(points)[:, :, 0], [[0, 1], [3, 4]])


def seen(outlook, aspect):
    """Where the points are on the screen, from -1 to 1 across and from bottom to top, through a pinhole."""
    position, up = place(outlook, aspect)
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    sight = outlook.points - position
    depth = np.tan(outlook.fov / 2) * (sight @ forward)
    return np.stack((sight @ right / (depth * aspect), sight @ np.cross(right, forward) / depth), axis=1)


CORRIDOR = np.array([[x, y, 0.0] for x in (-24.0, 24.0) for y in (-3.0, 3.0)])


@pytest.mark.parametrize("aspect", [0.3, 0.5, 1.0, 1.9])
@pytest.mark.parametrize("turns", [False, True])
def test_a_camera_fills_its_pane_with_the_scene(aspect, turns):
    """Something touches the margin, and nothing is beyond it."""
    outlook = Outlook(CORRIDOR, np.array([0.0, -0.3, 0.9]), np.array([0.0, 0.0, 1.0]), 0.6, turns)
    assert np.abs(seen(outlook, aspect)).max() == pytest.approx(MARGIN)


def test_a_long_scene_is_turned_in_a_high_pane_only():
    plan = Outlook(CORRIDOR, np.array([0.0, -0.01, 1.0]), np.array([0.0, 1.0, 0.0]), 0.6, True)
    high, wide = seen(plan, 0.45), seen(plan, 1.6)
    across, upright = np.ptp(high, axis=0)
    assert upright == pytest.approx(2 * MARGIN, rel=0.01)
    # East is up: the two eastern corners are the highest. North is then to the left.
    assert set(np.argsort(high[:, 1])[2:]) == {2, 3} and high[3, 0] < high[2, 0]
    assert np.ptp(wide, axis=0)[0] == pytest.approx(2 * MARGIN, rel=0.01) and wide[2, 0] > wide[0, 0]
    still = np.ptp(seen(plan._replace(turns=False), 0.45), axis=0)
    assert upright * across > 3 * still[0] * still[1]


def pull(first, t, fresh=False):
    n = len(t)
    column = np.arange(first, first + n, dtype=float)
    track = SimpleNamespace(
        mean=column[:, None], std=column[:, None], nis=column, nis_mean=column, nis_low=column, nis_high=column,
        verdict=np.zeros(n, np.int8),
    )  # fmt: skip
    readings = SimpleNamespace(
        t=np.array(t, np.int64), kind=np.zeros(n, np.int8), channel=np.zeros(n, np.int32), value=column[:, None]
    )

    class Batch(SimpleNamespace):
        def __len__(self):
            return n

    return SimpleNamespace(first=first, fresh=fresh, events=Batch(**vars(readings)), track=track)


def test_history_overwrites_rewritten_rows():
    history = History(1, 1)
    assert history.update(pull(0, [0, 10, 20, 30])) == 0
    assert history.update(pull(2, [15, 20, 30])) == 2
    np.testing.assert_array_equal(history.column("t"), [0, 10, 15, 20, 30])


def test_history_slides():
    history = History(1, 1)
    history.span = 1_000
    for first in range(0, 100_000, 500):
        history.update(pull(first, range(100 + first, 600 + first)))
        history.trim()
    assert history.n <= 2_000
    np.testing.assert_array_equal(history.column("mean")[:, 0] + 100, history.column("t"))


def test_history_never_holds_more_than_twice_its_limit():
    history = History(1, 1, limit=100)
    for first in range(0, 1_000, 90):
        history.update(pull(first, range(first, first + 90)))
        assert 90 <= history.n <= 200
        np.testing.assert_array_equal(history.column("t"), np.arange(history.base, first + 90))


def test_history_starts_over_with_a_fresh_pull():
    history = History(1, 1)
    history.update(pull(0, range(100)))
    history.update(pull(40, range(40, 60), fresh=True))
    assert (history.base, history.n) == (40, 20)


def test_a_trail_says_nothing_of_places_that_only_a_prior_knows():
    plane, std = np.arange(20.0).reshape(10, 2), np.full((10, 2), 0.1)
    std[:3] = 50.0, 20.0
    found = where_known(plane, std)
    assert np.isnan(found[:3]).all()
    np.testing.assert_array_equal(found[3:], plane[3:])
    # While nothing better is known, it is drawn; and while it is lost for a while.
    np.testing.assert_array_equal(where_known(plane[:3], std[:3]), plane[:3])
    std[5:] *= np.linspace(1.0, 15.0, 5)[:, None]
    np.testing.assert_array_equal(where_known(plane, std)[3:], plane[3:])


def test_a_trail_has_a_gap_where_the_estimate_leapt():
    way = np.column_stack((np.arange(50.0), np.zeros(50), np.full(50, 0.06)))
    np.testing.assert_array_equal(without_jumps(way), way)
    way[30:, 0] += 40.0
    found = without_jumps(way)
    assert len(found) == 51 and np.isnan(found[30]).all()
    np.testing.assert_array_equal(np.delete(found, 30, axis=0), way)
    # At rest, and of nothing, there is no leap.
    for count in (0, 1, 7):
        assert without_jumps(np.ones((count, 3))).shape == (count, 3)
