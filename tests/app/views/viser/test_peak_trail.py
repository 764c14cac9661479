"""The way of an estimate with several peaks, against a walk whose mean is between two corridors."""

import numpy as np

from app.views.viser.vehicle_scene import PeakTrail

T = np.arange(10, dtype=np.int64) * 10**9
MEAN = np.column_stack((np.arange(10.0), np.full(10, 5.0)))  # in the middle, where nothing is
PEAK = np.array([3.0, 0.0])


def test_without_several_peaks_it_is_the_mean():
    trail = PeakTrail()
    assert trail.of(T, MEAN) is MEAN
    for n in range(1, 11):
        trail.look(T[:n], MEAN[:n], None)
    np.testing.assert_array_equal(trail.of(T, MEAN), MEAN)


def test_where_there_are_several_it_is_the_heaviest_and_no_row_of_the_mean():
    """Looked at every other row; two peaks at rows 3 and 5, one from row 7 on."""
    trail = PeakTrail()
    for n, peak in ((2, None), (4, PEAK), (6, PEAK + [2, 0]), (8, None)):
        trail.look(T[:n], MEAN[:n], peak)
    expected = [*MEAN[:2], PEAK, PEAK + [2, 0], *MEAN[6:]]
    np.testing.assert_array_equal(trail.of(T, MEAN), expected)
    # Rows that follow the last look are as that was: none of them is drawn where nothing is.
    trail.look(T[:9], MEAN[:9], PEAK + [5, 0])
    np.testing.assert_array_equal(trail.of(T, MEAN), [*expected[:-2], PEAK + [5, 0]])


def test_rows_that_are_others_by_now_had_other_peaks():
    trail = PeakTrail()
    trail.look(T[:4], MEAN[:4], PEAK)
    other = MEAN + 1.0
    trail.look(T[:6], other[:6], None)
    np.testing.assert_array_equal(trail.of(T[:6], other[:6]), other[:6])
    # A source that began again is at an earlier time.
    trail.look(T[:6], other[:6], PEAK)
    trail.look(T[:2], MEAN[:2], None)
    np.testing.assert_array_equal(trail.of(T[:2], MEAN[:2]), MEAN[:2])


def test_looks_that_left_the_history_are_not_drawn():
    trail = PeakTrail()
    trail.look(T[:2], MEAN[:2], PEAK)
    trail.look(T[:6], MEAN[:6], None)
    np.testing.assert_array_equal(trail.of(T[3:6], MEAN[3:6]), MEAN[3:6])
