"""Merging keeps every event, in order of time, ties in the order of the sources."""

import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import READING, Events
from sources.merged import MemorySource, Merged
from tests.sources.can.can_tools import same
from tests.support import read_all


def events(times, who):
    return Events.alike(READING, np.array(times, np.int64), np.arange(len(times), dtype=float), who)


@pytest.mark.parametrize("seed", range(20))
def test_merged_is_the_stable_sort_of_all(seed):
    rng = np.random.default_rng(seed)
    # Few distinct times, so that ties fall on the borders of batches too.
    parts = [events(np.sort(rng.integers(0, 30, rng.integers(0, 60))), k) for k in range(4)]
    whole = Events.concat(parts, 1)
    expected = whole.select(np.argsort(whole.t, kind="stable"))
    merged = Merged([MemorySource(part, batch=int(rng.integers(1, 9))) for part in parts])
    assert same(read_all(merged), expected)


def test_a_late_reading_stays_behind_the_one_that_came_before_it():
    merged = Merged([MemorySource(events([1, 5, 3, 6], 0)), MemorySource(events([2, 4], 1))])
    got = read_all(merged)
    assert list(zip(got.t.tolist(), got.channel.tolist(), strict=True)) == [
        (1, 0), (2, 1), (4, 1), (5, 0), (3, 0), (6, 0)
    ]  # fmt: skip


def test_span_and_refusals():
    merged = Merged([MemorySource(events([3, 9], 0)), MemorySource(events([1, 4], 1))])
    assert merged.span == (1, 9) and not merged.endless and not merged.live and merged.now() is None
    live = MemorySource(events([1], 0))
    live.live = True
    with pytest.raises(SourceError, match="a live source cannot be merged"):
        Merged([live])
    with pytest.raises(SourceError, match="name at least one"):
        Merged([])


def test_bus_and_gnss_of_one_drive(data):
    """BLF and two GNSS tables of a car: one log in order, positions along the road that its README describes."""
    from estimators.log import READING
    from sources.can.decoder import Decoder
    from sources.can.log import CanLog
    from sources.source import Channel
    from sources.tables.table import Table, TimeColumn

    folder = data("can_comma2k19_rav4")
    speed = Channel(READING, 0, "speed", ("SPEED",), "SPEED", model_units=("m/s",))
    fix = Channel(READING, 1, "gnss", ("lat_deg", "lon_deg"), model_units=("m", "m"), convert="east_north")
    ground = Channel(READING, 2, "ground", ("speed_mps",), model_units=("m/s",))
    other = Channel(READING, 3, "other", ("speed_mps",), model_units=("m/s",))
    merged = Merged(
        [
            CanLog(
                [folder / "rav4_2018-08-02_seg40.blf"],
                Decoder([(folder / "dbc" / "toyota_2017.dbc", 0)], [speed], width=2),
            ),
            Table([folder / "gnss_ublox.csv"], time=TimeColumn("t_utc"), channels=[fix, ground], width=2),
            Table([folder / "gnss_qcom.csv"], time=TimeColumn("t_utc"), channels=[other], width=2),
        ]
    )
    got = read_all(merged)
    assert np.all(np.diff(got.t) >= 0)
    counts = np.bincount(got.channel)
    assert counts[1:].tolist() == [579, 579, 30] and counts[0] > 2400
    east, north = got.value[got.channel == 1, :2].T
    assert np.hypot(east[-1], north[-1]) == pytest.approx(1011, rel=0.02) and abs(east[-1]) < 60
    on_can = np.interp(got.t[got.channel == 2], got.t[got.channel == 0], got.value[got.channel == 0, 0])
    # The CAN speed reads 1 % low, and the receiver lags a little where the car brakes.
    assert np.median(np.abs(on_can - got.value[got.channel == 2, 0])) < 0.5
