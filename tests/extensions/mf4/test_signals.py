"""Signals of MDF files: what was written is read, by raster."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

asammdf = pytest.importorskip("asammdf", reason="needs asammdf: pip install 'nisus[mf4]'")

import can  # noqa: E402

from estimators.errors import SourceError  # noqa: E402
from sources.can import log_writer  # noqa: E402
from sources.inspect import inspect_recordings  # noqa: E402
from tests.support import error_of  # noqa: E402

START_NS = 1_710_489_600 * 10**9
FAST = np.arange(500) * 0.01
SLOW = np.arange(51) * 0.1


def signal(t, values, name, unit="", **other):
    return asammdf.Signal(values, t, unit, name, **other)


def saved(path, *groups, version="4.10"):
    mdf = asammdf.MDF(version=version)
    mdf.header.start_time = datetime.fromtimestamp(START_NS // 10**9, UTC)
    for label, group in groups:
        mdf.append(group, acq_name=label, common_timebase=True)
    saved = mdf.save(path, overwrite=True)
    mdf.close()
    return saved.rename(path)  # whose ending asammdf chooses


def columns(path):
    return {one.name: one for one in inspect_recordings([path]).columns}


@pytest.mark.parametrize(("name", "version"), [("a.mf4", "4.10"), ("a.mdf", "3.30"), ("a.dat", "3.30")])
def test_each_raster_has_its_own_times(tmp_path, name, version):
    speed, heat = 800 + np.arange(500.0), 60 + 0.5 * np.arange(51.0)
    fan = (np.arange(51) % 2).astype(np.uint8)
    fast = [signal(FAST, speed, "nEng", "1/min")]
    slow = [signal(SLOW, heat, "tCoolant", "°C"), signal(SLOW, fan, "fan")]
    found = columns(saved(tmp_path / name, ("10ms", fast), ("100ms", slow), version=version))
    assert list(found) == ["nEng [1/min]", "tCoolant [°C]", "fan"]
    assert [found[key].unit for key in found] == ["1/min", "°C", ""]
    for key, t, values in (("nEng [1/min]", FAST, speed), ("tCoolant [°C]", SLOW, heat), ("fan", SLOW, fan)):
        assert found[key].t.tolist() == [START_NS + round(second * 1e9) for second in t]
        assert found[key].values.tolist() == values.tolist()


def test_a_sample_that_is_marked_invalid_is_missing(tmp_path):
    marked = np.zeros(51, np.bool_)
    marked[[3, 4, 40]] = True
    parts = [signal(SLOW, np.arange(51.0), "p", "bar", invalidation_bits=marked), signal(SLOW, np.ones(51), "q")]
    found = columns(saved(tmp_path / "a.mf4", ("g", parts)))
    assert found["p [bar]"].values.tolist() == [k for k in range(51) if k not in (3, 4, 40)]
    assert (found["p [bar]"].missing, found["q"].missing) == (3, 0)


def test_channels_of_one_name_are_told_apart_by_their_groups(tmp_path):
    groups = [("A", [signal(SLOW, np.ones(51), "x", "V")]), ("B", [signal(SLOW, np.full(51, 2.0), "x", "V")])]
    groups += [("B", [signal(SLOW, np.full(51, 3.0), "x", "V")])]
    found = columns(saved(tmp_path / "a.mf4", *groups))
    assert {name: one.values[0] for name, one in found.items()} == {"A.x [V]": 1, "1.B.x [V]": 2, "2.B.x [V]": 3}


def test_an_enumeration_is_its_numbers_an_array_its_elements_and_texts_are_left_out(tmp_path):
    gear = signal(
        SLOW,
        np.array([1, 2, 3] * 17, np.uint8),
        "gear",
        conversion={"val_0": 1, "val_1": 2, "text_0": b"first", "text_1": b"second", "default": b""},
    )
    words = signal(SLOW, np.array([b"on "] * 51), "state", encoding="utf-8")
    field = signal(SLOW, np.rec.fromarrays([np.arange(153.0).reshape(51, 3)], dtype=[("field", "<f8", (3,))]), "field")
    found = columns(saved(tmp_path / "a.mf4", ("g", [gear, words, field])))
    assert list(found) == ["gear", "field[0]", "field[1]", "field[2]"]
    assert [one.values[:3].tolist() for one in found.values()] == [[1, 2, 3], [0, 3, 6], [1, 4, 7], [2, 5, 8]]


def test_frames_of_can_stay_a_log_and_a_file_of_texts_is_refused(tmp_path):
    with log_writer(tmp_path / "can.mf4") as log:
        for k in range(30):
            log(can.Message(timestamp=START_NS / 1e9 + k, arbitration_id=256, is_extended_id=False, data=bytes(8)))
    assert inspect_recordings([tmp_path / "can.mf4"]).kind == "can_log"
    words = saved(tmp_path / "a.mf4", ("g", [signal(SLOW, np.array([b"on "] * 51), "state", encoding="utf-8")]))
    said = error_of(SourceError, inspect_recordings, [words])
    assert said == f"{words}: it holds no signals with a time; export them again, or as CSV"


def test_a_cut_file_is_refused_in_one_line(tmp_path):
    path = saved(tmp_path / "a.mf4", ("g", [signal(SLOW, np.arange(51.0), "p")]))
    path.write_bytes(path.read_bytes()[:-400])
    assert error_of(SourceError, inspect_recordings, [path]).startswith(f"{path}: ")
