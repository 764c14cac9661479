"""Groups of rows: extremes as a loop finds them, however the rows came."""

import numpy as np
import pytest

from app.charts.levels_of_detail import FIRST, Pyramid, coarser, grouped


def by_hand(size, first, t, values):
    """Number → times of the ends, and extremes of each column, by Python's own min and max."""
    rows: dict[int, list[int]] = {}
    for k in range(len(t)):
        rows.setdefault((first + k) // size, []).append(k)
    found = {}
    for number, own in rows.items():
        columns = [[v for v in values[own, c] if not np.isnan(v)] for c in range(values.shape[1])]
        low, high = ([pick(c, default=np.nan) for c in columns] for pick in (min, max))
        found[number] = (t[own[0]], t[own[-1]], low, high)
    return found


def same(groups, wanted):
    assert list(range(groups.start, groups.start + groups.n)) == list(wanted)
    for k, (first, last, low, high) in enumerate(wanted.values()):
        assert (groups.first[k], groups.last[k]) == (first, last)
        np.testing.assert_array_equal(groups.low[k], low)
        np.testing.assert_array_equal(groups.high[k], high)


def rows(n, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(n, 3))
    values[rng.random((n, 3)) < 0.3] = np.nan
    return np.sort(rng.integers(0, 10**9, n)), values


@pytest.mark.parametrize(("size", "first"), [(1, 0), (4, 0), (4, 3), (5, 7), (12, 0), (16, 15), (16, 16), (64, 1000)])
def test_groups_hold_the_extremes(size, first):
    t, values = rows(333)
    same(grouped(size, first, t, values), by_hand(size, first, t, values))


def test_coarser_groups_are_those_of_the_rows():
    t, values = rows(1000)
    same(coarser(grouped(16, 40, t, values)), by_hand(64, 40, t, values))


def test_levels_are_the_same_in_whatever_pieces_the_rows_come():
    """Appended in pieces, and rewritten from an earlier row on, as after a late reading."""
    t, values = rows(5000)
    rng = np.random.default_rng(1)
    pyramid, end = Pyramid(3), 0
    while end < 5000:
        first = max(0, end - int(rng.integers(0, 300))) // FIRST * FIRST
        end = min(5000, end + int(rng.integers(1, 700)))
        # What was there before the rewrite is wrong: the newest rows are void.
        pyramid.update(first, t[first:end], values[first:end] + 7.0)
        pyramid.update(first, t[first:end], values[first:end])
    for size in (16, 64, 256, 1024, 4096):
        same(pyramid.level(size), by_hand(size, 0, t, values))


def test_fewer_rows_than_before():
    t, values = rows(500)
    pyramid = Pyramid(3)
    pyramid.update(0, t, values)
    pyramid.update(160, t[160:200], values[160:200])
    same(pyramid.level(16), by_hand(16, 0, t[:200], values[:200]))
    same(pyramid.level(64), by_hand(64, 0, t[:200], values[:200]))


def test_what_is_dropped_is_forgotten():
    t, values = rows(5000)
    pyramid = Pyramid(3)
    pyramid.update(0, t, values)
    pyramid.forget(4000)
    same(pyramid.level(16), by_hand(16, 4000, t[4000:], values[4000:]))
    pyramid.update(4992, t[4992:], values[4992:])
    same(pyramid.level(16), by_hand(16, 4000, t[4000:], values[4000:]))
