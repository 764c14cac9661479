"""Pictures of a field: the same in any pieces, worth what a direct count says, averaged and thinned as promised."""

import numpy as np
import pytest

from estimators.diagnostics import field_pictures as module
from estimators.diagnostics.field_pictures import Picture, plane, plane_shape
from estimators.diagnostics.score import score
from estimators.fold import Fold
from estimators.log import READING, TRUTH, Events, Log
from estimators.model.parts import Field
from estimators.models.thermal_field import thermal_field
from estimators.tuning import Tuning
from sources.simulator import Simulator
from tests.support import read_all

MODEL = thermal_field(12, 9, 2)
SECONDS = 24
EVERY = 4


@pytest.fixture(scope="module")
def events():
    source = Simulator(MODEL, seed=3, step=1.0, duration=SECONDS, truth_every=EVERY)
    return read_all(source)


def growing(log, picture=2.0):
    # Too sure of itself, so that errors lie on both sides of the band.
    tuning = Tuning.of(MODEL).with_options({"members": 12, "radius": 0.05})
    tuning = tuning.set("Q.temperature", 1e-5).set("R.thermocouples", 0.01)
    return Fold("ensrf", MODEL, tuning, log, picture=picture)


def folded(events, cuts=(), picture=2.0):
    log = Log(MODEL.width)
    fold = growing(log, picture)
    for part in np.split(np.arange(len(events)), cuts):
        log.extend(events.select(part))
        fold.advance()
    return fold


def assert_same_pictures(ours, theirs):
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        for name, x, y in zip(Picture._fields, a, b, strict=True):
            np.testing.assert_array_equal(x, y, err_msg=name)


def test_pictures_do_not_depend_on_how_the_log_came(events):
    whole = folded(events).pictures.taken
    # Every second second ends a period, and every fourth the truth was told: 3, 4, 5, 7, 8, ... (0 is a tick's).
    times = sorted({*range(1, SECONDS, 2), *range(EVERY, SECONDS, EVERY)})
    assert [picture.t // 10**9 for picture in whole] == times
    assert_same_pictures(folded(events, range(1, len(events))).pictures.taken, whole)
    assert_same_pictures(folded(events, [7, 40, 41, 100]).pictures.taken, whole)


def test_a_late_reading_takes_the_pictures_behind_it_again(events):
    late = np.flatnonzero((events.kind == READING) & (events.t == 9 * 10**9))[0]
    others = np.delete(np.arange(len(events)), late)
    log = Log(MODEL.width)
    fold = growing(log)
    log.extend(events.select(others))
    fold.advance()
    before = list(fold.pictures.taken)
    first, _ = log.extend(events.select(slice(late, late + 1)))
    fold.rewind(first)
    fold.advance()
    fresh = growing(log)
    fresh.advance()
    assert_same_pictures(fold.pictures.taken, fresh.pictures.taken)
    changed = [bool((a.mean != b.mean).any()) for a, b in zip(before, fresh.pictures.taken, strict=True)]
    assert changed == [picture.t >= 9 * 10**9 for picture in before]


def test_errors_over_all_cells_are_those_of_the_estimate_at_that_time(events):
    """At each telling the events up to it are folded anew and the errors counted one by one."""
    fold = folded(events, picture=None)
    fold.finish()
    taken = fold.pictures.taken
    assert [picture.t for picture in taken] == [k * 10**9 for k in range(EVERY, SECONDS + 1, EVERY)]
    squares, inside = [], []
    for picture in taken:
        part = events.select(events.t <= picture.t)
        log = Log(MODEL.width)
        log.extend(part)
        again = growing(log)
        again.advance()
        mean, cov = again.moments()
        last = part.select((part.kind == TRUTH) & (part.t == picture.t))
        truth = np.full(MODEL.nx, np.nan)
        for first, row in zip(last.channel, last.value, strict=True):
            for k, value in enumerate(row):
                if np.isfinite(value):
                    truth[first + k] = value
        error, std = mean - truth, np.sqrt(np.diag(cov))
        assert picture.cells == MODEL.nx
        assert picture.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
        assert picture.spread == pytest.approx(np.sqrt(np.mean(std**2)), rel=1e-12)
        assert picture.inside == np.mean(np.abs(error) <= 1.959963984540054 * std)
        np.testing.assert_allclose(picture.truth, truth.reshape(12, 9), rtol=1e-6)
        np.testing.assert_allclose(picture.std, std.reshape(12, 9), rtol=1e-6)
        squares.append(error**2)
        inside.append(picture.inside)
    assert min(inside) < 0.9
    result = score(fold.track, events, MODEL, taken)
    assert result.field.rmse == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-12)
    assert result.field.coverage == pytest.approx(np.mean(inside), rel=1e-12)
    assert score(fold.track, events, MODEL).field is None


def test_what_is_forgotten_in_front_takes_its_pictures_along(events):
    fold = folded(events)
    count, _ = fold.base_at(len(events) // 2)
    if not count:
        fold.snapshots._kept[60] = fold.snapshots[0]
        count = 60
    expected = [picture for picture in fold.pictures.taken if picture.before >= count]
    fold.drop_front(count)
    assert_same_pictures(fold.pictures.taken, expected)


def test_a_large_field_is_averaged_over_squares_the_last_ones_smaller():
    shape = (430, 205)
    assert plane_shape(shape) == (144, 69)
    values = np.random.default_rng(0).normal(size=shape)
    image = plane(values.ravel(), shape)
    assert image.dtype == np.float32
    for i, j in ((0, 0), (143, 0), (71, 68), (143, 68)):
        expected = values[3 * i : 3 * i + 3, 3 * j : 3 * j + 3].mean()
        assert image[i, j] == pytest.approx(expected, rel=1e-5)
    values[5, 7] = np.nan
    assert np.argwhere(np.isnan(plane(values.ravel(), shape))).tolist() == [[1, 2]]
    assert plane(np.arange(70.0), (70,)).shape == (1, 70)
    cube = np.arange(3 * 20 * 10.0).reshape(3, 20, 10)
    np.testing.assert_array_equal(plane(cube.ravel(), cube.shape), cube[1])


def test_pictures_keep_within_their_memory_and_their_numbers_stay(monkeypatch):
    monkeypatch.setattr(module, "MAX_PICTURE_BYTES", 12 * 8 * 10)
    field = Field("t", "K", (2, 4))
    pictures = module.Pictures(field, 1.0)
    log = Log(8)
    for second in range(100):
        log.extend(Events.one(second * 10**9, 0, READING, 0, [np.nan], 8))
        if second:
            assert pictures.check(log, second)
            pictures.take(log, second, np.full(8, second), np.ones(8))
    kept = [picture.t // 10**9 for picture in pictures.taken if picture.mean is not None]
    assert len(kept) <= 10 and kept[0] == 0 and kept[-4:] == [95, 96, 97, 98]
    assert [picture.t // 10**9 for picture in pictures.taken] == list(range(99))
