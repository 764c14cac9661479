"""The gate on recordings of real assets: a fix that jumps, a wheel too large, a start elsewhere, a new level."""

import csv
from datetime import UTC, datetime

import numpy as np
import pytest

from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.track import GATED
from estimators.tuning import Tuning
from tests.models import level_model
from tests.support import as_log, folded

JUMP = 300.0
"""Seconds into the drive."""


class Drive:
    """The first minutes of the road car's drive, and what the undamaged log says of where it was."""

    def __init__(self):
        self.twin = load_twin("road_car")
        log, _ = read_log(self.twin, 450.0)
        self.events = Events(*(np.array(column) for column in log.events))
        self.seconds = (self.events.t - self.events.t[0]) * 1e-9
        self.place = self.fold(self.events).track.mean[:, :2].copy()

    def fold(self, events, tuning=None, prior=None):
        return folded("ekf", self.twin.model, as_log(events), tuning or self.twin.tuning, prior=prior)

    def changed(self, sensor, change, first=0.0, last=np.inf):
        """The events, the first row of one sensor's readings between two times changed."""
        events = Events(*(column.copy() for column in self.events))
        mine = (events.kind == READING) & (events.channel == self.twin.model.sensor_names.index(sensor))
        mine &= (self.seconds >= first) & (self.seconds < last)
        events.value[mine, 0] = change(events.value[mine, 0])
        return events

    def decisions(self, growing, sensor="gnss_position", begun=JUMP):
        first = self.events.t[0] * 1e-9
        return [(d.time - first, d.outcome) for d in growing.decisions if d.sensor == sensor and d.time - first > begun]


@pytest.fixture(scope="module")
def drive(data):
    data("can_css_imu100_obd2")
    return Drive()


@pytest.mark.parametrize("metres", [50.0, 500.0])
def test_a_fix_that_jumps_for_ever_is_followed_after_half_a_minute(drive, metres):
    """No other sensor sees where the car is, so nothing tells, and after 30 s the asset is believed."""
    growing = drive.fold(drive.changed("gnss_position", lambda east: east + metres, JUMP))
    (doubted, first), (believed, second) = drive.decisions(growing)[:2]
    assert (first, second) == ("doubted", "believed")
    assert doubted < JUMP + 5.0 and JUMP + 29.0 < believed < JUMP + 35.0
    error = np.hypot(*(growing.track.mean[:, :2] - drive.place).T)
    assert np.max(error[(drive.seconds > JUMP) & (drive.seconds < believed - 0.1)]) < 10.0
    shifted = np.hypot(*(growing.track.mean[:, :2] - drive.place - [metres, 0.0]).T)
    assert np.max(shifted[drive.seconds > believed + 5.0]) < 5.0


def test_a_fix_that_jumps_for_less_is_never_followed(drive):
    growing = drive.fold(drive.changed("gnss_position", lambda east: east + 500.0, JUMP, JUMP + 20.0))
    assert [outcome for _, outcome in drive.decisions(growing)] == ["doubted", "agrees"]
    error = np.hypot(*(growing.track.mean[:, :2] - drive.place).T)
    assert np.max(error[drive.seconds > JUMP]) < 10.0


def test_a_wheel_ten_percent_long_does_not_lose_the_car(drive):
    events = drive.changed("wheel_speed", lambda speed: 1.1 * speed)
    late = drive.seconds > 250.0
    errors = []
    for reopen in (None, 30.0):
        growing = drive.fold(events, drive.twin.tuning.set("gate.reopen", reopen))
        errors.append(np.median(np.hypot(*(growing.track.mean[:, :2] - drive.place).T)[late]))
    assert errors[0] > 100.0 and errors[1] < 1.0
    assert "reopened" in [outcome for _, outcome in drive.decisions(growing, begun=0.0)]


def test_a_twin_begun_300_m_off_believes_its_first_fixes(drive):
    begin = int(np.searchsorted(drive.seconds, JUMP))
    whole = drive.fold(drive.events)
    mean, cov = whole.track.mean[begin].copy(), np.diag(whole.track.std[begin] ** 2)
    mean[0] += 300.0
    growing = drive.fold(drive.events.select(slice(begin, None)), prior=(mean, cov))
    first = next(d for d in growing.decisions if d.sensor == "gnss_position")
    assert first.outcome == "believed" and "from its first" in first.text
    error = np.hypot(*(growing.track.mean[:, :2] - drive.place[begin:]).T)
    assert np.max(error[drive.seconds[begin:] > JUMP + 60.0]) < 10.0


OFFICE = level_model(
    {"air": 0.25}, 0.02 / 3600.0, state="temperature", mean=69.9, std=5.0, max_step=3600.0, linear=True
)


def locked_out(growing):
    """Hours of the longest stretch in which every reading was refused."""
    t, longest, begun = growing.events.t / 3.6e12, 0.0, None
    for now, verdict in zip(t, growing.track.verdict, strict=True):
        begun = (now if begun is None else begun) if verdict == GATED else None
        longest = max(longest, 0.0 if begun is None else now - begun)
    return longest


def test_an_office_that_changes_its_level_is_followed(data):
    """One sensor, so nothing tells, and the asset is believed after six hours.

    Q is a fifth of what the series asks for, so that the gate refuses mornings too; where they rise so fast that even a
    twin which believes them refuses the next, they are taken for a sensor's fault, and asked again after six hours.
    """
    with data("industrial_nab_temperature", "ambient_temperature_system_failure.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    log = Log.of(OFFICE)
    seconds = [datetime.fromisoformat(stamp).replace(tzinfo=UTC).timestamp() for stamp, _ in rows]
    log.add("air", seconds, [float(value) for _, value in rows])
    tuning = Tuning.of(OFFICE).set("gate", 0.9999)
    folds = [Fold("kf", OFFICE, tuning.set("gate.reopen", reopen), log) for reopen in (None, 6 * 3600.0)]
    for growing in folds:
        growing.advance()
    assert locked_out(folds[0]) > 48.0 and locked_out(folds[1]) < 24.0
    errors = [np.sqrt(np.mean((growing.track.mean[:, 0] - log.events.value[:, 0]) ** 2)) for growing in folds]
    assert errors[1] < 0.85 * errors[0]
    outcomes = [decision.outcome for decision in folds[1].decisions]
    assert outcomes.count("believed") > 5 * outcomes.count("isolated")
