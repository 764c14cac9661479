"""What the Viser pane computes before it draws: decimation, ellipsoids, ticks, ranges, the sliding history."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.drawing.geometry import ellipsoid, quaternion, round_step, segments, tick_text
from app.viser.camera import vertical_angle
from app.viser.charts import Range
from app.viser.decimate import Buckets, bridge
from app.viser.history import History


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


@pytest.mark.parametrize("aspect", [0.3, 0.5, 1.0, 1.9])
def test_camera_sees_the_same_in_a_narrow_pane(aspect):
    """Half the scene's width at distance 1 stays tan(fov/2) in the narrower direction."""
    half_height = np.tan(vertical_angle(0.6, aspect) / 2)
    assert min(half_height, half_height * aspect) == pytest.approx(np.tan(0.3))


def test_decimation_keeps_every_extreme():
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(0, 60_000_000_000, 50_000))
    values = rng.normal(size=(t.size, 3))
    values[17_321] = [40.0, -50.0, 60.0]
    buckets = Buckets(3, 200_000_000)
    buckets.update(t, 0, lambda start, end: values[start:end])
    times, drawn = buckets.points(0)
    assert times.size <= 2 * 301
    assert np.all(np.diff(times) >= 0)
    for bucket in range(0, 300, 7):
        rows = t // 200_000_000 == bucket
        points = times // 200_000_000 == bucket
        np.testing.assert_array_equal(drawn[points].min(axis=0), values[rows].min(axis=0))
        np.testing.assert_array_equal(drawn[points].max(axis=0), values[rows].max(axis=0))


def test_decimation_in_pieces_equals_decimation_at_once():
    """Rows that come a few at a time, and rows rewritten by a late one, give what one pass over all rows gives."""
    rng = np.random.default_rng(2)
    t = np.sort(rng.integers(0, 10_000_000_000, 2_000))
    values = rng.normal(size=(t.size, 2))
    pieces, end = Buckets(2, 100_000_000), 0
    while end < t.size:
        begin, end = end, min(t.size, end + int(rng.integers(1, 60)))
        pieces.update(t[:end], begin, lambda start, stop: values[start:stop])
    values[1_500:] += 10.0
    pieces.update(t, 1_500, lambda start, stop: values[start:stop])
    whole = Buckets(2, 100_000_000)
    whole.update(t, 0, lambda start, stop: values[start:stop])
    for one, other in zip(pieces.points(0), whole.points(0), strict=True):
        np.testing.assert_array_equal(one, other)


def test_decimation_outlives_the_rows_it_came_from():
    """Buckets whose rows are gone stay as they were, and one whose first rows are gone keeps their extremes."""
    rng = np.random.default_rng(3)
    t = np.arange(0, 10_000_000_000, 1_000_000)
    values = rng.normal(size=(t.size, 2))
    buckets, seen = Buckets(2, 700_000_000), 0
    for end in range(37, t.size + 37, 37):
        end, gone = min(end, t.size), max(0, end - 300)
        buckets.update(
            t[gone:end], seen - gone, lambda start, stop, gone=gone: values[gone + start : gone + stop]
        )  # fmt: skip
        seen = end
    whole = Buckets(2, 700_000_000)
    whole.update(t, 0, lambda start, stop: values[start:stop])
    for name in ("first", "last", "low", "high"):
        np.testing.assert_array_equal(getattr(buckets, name), getattr(whole, name))
    buckets.forget(5_000_000_000)
    assert buckets.last[0] >= 5_000_000_000 and buckets.first.size == (whole.last >= 5_000_000_000).sum()


def test_coarser_buckets_are_those_of_twice_the_width():
    rng = np.random.default_rng(4)
    t = np.sort(rng.integers(0, 10_000_000_000, 3_000))
    values = rng.normal(size=(t.size, 2))
    fine, coarse = Buckets(2, 100_000_000), Buckets(2, 200_000_000)
    for buckets in (fine, coarse):
        buckets.update(t, 0, lambda start, stop: values[start:stop])
    fine.coarsen()
    for name in ("first", "last", "low", "high"):
        np.testing.assert_array_equal(getattr(fine, name), getattr(coarse, name))


def test_decimation_draws_a_lone_reading_once():
    values = np.full((10, 1), np.nan)
    values[4] = 3.0
    buckets = Buckets(1, 1_000)
    buckets.update(np.arange(10), 0, lambda start, end: values[start:end])
    _, drawn = buckets.points(0)
    assert np.isfinite(drawn).sum() == 1


def test_bridge_fills_between_but_not_beyond():
    np.testing.assert_array_equal(bridge(np.array([np.nan, 1.0, np.nan, 3.0, np.nan])), [np.nan, 1.0, 2.0, 3.0, np.nan])


def test_range_grows_at_once_and_does_not_twitch():
    axis = Range()
    first = axis.series([np.array([0.0, 1.0, 0.5])])
    assert first[0] < 0.0 and first[1] > 1.0
    np.testing.assert_array_equal(axis.series([np.array([0.1, 0.9, 0.5])]), first)
    assert axis.series([np.array([0.0, 5.0, np.nan])])[1] > 5.0
    assert axis.series([np.array([0.0, 1.0, 0.5])])[1] < 2.0


def pull(first, t, fresh=False):
    n = len(t)
    column = np.arange(first, first + n, dtype=float)
    track = SimpleNamespace(
        mean=column[:, None], std=column[:, None], nis=column, nis_mean=column, nis_low=column, nis_high=column,
        verdict=np.zeros(n, np.int8), screened=np.zeros((n, 1), np.int8),
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
    assert history.take(pull(0, [0, 10, 20, 30])) == 0
    assert history.take(pull(2, [15, 20, 30])) == 2
    np.testing.assert_array_equal(history.column("t"), [0, 10, 15, 20, 30])


def test_history_slides_and_keeps_the_origin_of_time():
    history = History(1, 1)
    history.span = 1_000
    for first in range(0, 100_000, 500):
        history.take(pull(first, range(100 + first, 600 + first)))
        history.trim()
    assert history.n <= 2_000
    assert history.origin == 100
    np.testing.assert_array_equal(history.column("mean")[:, 0] + 100, history.column("t"))


def test_history_never_holds_more_than_twice_its_limit():
    history = History(1, 1, limit=100)
    for first in range(0, 1_000, 90):
        history.take(pull(first, range(first, first + 90)))
        assert 90 <= history.n <= 200
        np.testing.assert_array_equal(history.column("t"), np.arange(history.base, first + 90))


def test_history_starts_over_with_a_fresh_pull():
    history = History(1, 1)
    history.take(pull(0, range(100)))
    history.take(pull(40, range(40, 60), fresh=True))
    assert (history.base, history.n) == (40, 20)
