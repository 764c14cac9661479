"""The advice on a bare recording: noise, pairs and lags are found as they were put there; a draft that runs."""

import numpy as np
import pytest

from app.studies.advice.relations import driven, pairs
from app.studies.advice.signals import rough, signal
from app.twin.twin import load_twin
from sources.inspect import SignalSeries


def series(name, values, dt=0.1, start=0.0):
    t = np.round((start + np.arange(values.size) * dt) * 1e9).astype(np.int64)
    return SignalSeries(name, "", t, values)


def test_noise_is_found_beneath_a_curve():
    """Of 5,000 values a deviation is told to some 1.5 %, as three neighbours share a residual."""
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.05, 0.15, 5000))
    values = 3.0 * np.sin(t / 20.0) + rng.normal(0, 0.2, t.size)
    assert rough(np.round(t * 1e9).astype(np.int64), values) == pytest.approx(0.2, rel=0.05)
    # What is straight has none, at any times.
    assert rough(np.round(t * 1e9).astype(np.int64), 2.0 * t) < 1e-6


def test_resolution_bounds_the_noise():
    values = np.round(10.0 * np.sin(np.arange(2000) / 300.0) / 0.25) * 0.25
    found = signal(None, series("x", values))
    assert found.resolution == pytest.approx(0.25)
    assert found.noise >= 0.25 / np.sqrt(12.0)
    switch = signal(None, series("x", np.arange(100) // 10 % 2 * 1.0))
    assert switch.kind == "switch" and signal(None, series("x", np.ones(50))).kind == "constant"


def test_two_sensors_of_one_quantity_are_told_from_two_that_are_alike():
    rng = np.random.default_rng(2)
    walk = np.cumsum(rng.normal(0, 1, 3000))
    one, late = walk + rng.normal(0, 0.3, 3000), np.roll(walk, 5) * 2.0 + 7.0 + rng.normal(0, 0.3, 3000)
    drift = walk + np.cumsum(rng.normal(0, 0.05, 3000))
    found = [signal(None, series(name, x)) for name, x in (("a", one), ("b", late), ("c", drift))]
    by = {(pair.first, pair.second): pair for pair in pairs(found)}
    assert by[0, 1].one and by[0, 1].lag == pytest.approx(0.5) and by[0, 1].gain == pytest.approx(2.0, rel=0.01)
    assert by[0, 1].offset == pytest.approx(7.0, abs=0.5)
    assert not by[0, 2].one


def test_a_rate_is_recognised_with_its_bias():
    rng = np.random.default_rng(3)
    speed = 2.0 * np.sin(np.arange(4000) / 150.0) + np.cumsum(rng.normal(0, 0.02, 4000))
    place = np.cumsum(speed) * 0.1 + rng.normal(0, 0.02, 4000)
    read = -1.5 * speed + 0.4 + rng.normal(0, 0.1, 4000)
    (pair,) = pairs([signal(None, series("place", place)), signal(None, series("gyro", read))])
    assert pair.rate and (pair.first, pair.second) == (0, 1)
    assert pair.gain == pytest.approx(-1 / 1.5, rel=0.05) and pair.offset == pytest.approx(0.4 / 1.5, abs=0.05)


def lagging(rng, n=4000, tau=20.0, dt=0.1):
    """A first-order lag behind two of three inputs, which hold from their time on: 5 + 20 a - 10 b; and the inputs."""
    hold = [np.repeat(rng.normal(0, 1, n // 50), 50) for _ in range(3)]
    y, out, a = 5.0, [], np.exp(-dt / tau)
    for k in range(n):
        out.append(y)
        y = a * y + (1 - a) * (5.0 + 20.0 * hold[0][k] - 10.0 * hold[1][k])
    return np.array(out) + rng.normal(0, 0.02, n), hold


def test_what_drives_a_signal_is_found_with_its_time_constant():
    y, hold = lagging(np.random.default_rng(4))
    found = [signal(None, series(name, x)) for name, x in zip("yabc", (y, *hold), strict=True)]
    lag = driven(found, 0, [1, 2, 3])
    assert lag is not None and set(lag.drivers) == {1, 2} and lag.explained > 0.95
    assert lag.tau == pytest.approx(20.0, rel=0.05)
    gains = dict(zip(lag.drivers, lag.gains, strict=True))
    assert gains[1] == pytest.approx(20.0, rel=0.05) and gains[2] / gains[1] == pytest.approx(-0.5, rel=0.05)
    # An input follows nobody.
    assert driven(found, 1, [2, 3]) is None


@pytest.fixture
def table(tmp_path):
    """A recording: a tank's temperature behind a heater, two thermometers in it, and a room's by itself."""
    rng = np.random.default_rng(5)
    warmth, (heater, fan, _) = lagging(rng)
    room = 20.0 + np.cumsum(rng.normal(0, 0.05, warmth.size))
    columns = {
        "t": np.arange(warmth.size) * 0.1,
        "tank": warmth,
        "heater": heater,
        "fan": fan,
        "room": room + rng.normal(0, 0.1, warmth.size),
        "room_again": room + 1.0 + rng.normal(0, 0.1, warmth.size),
    }
    path = tmp_path / "tank.csv"
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return path


def test_a_draft_of_a_recording_runs_and_is_consistent(table, nisus):
    out = table.with_name("boiler.yaml")
    told = nisus("advise", str(table), "--json", "--out", str(out)).json
    assert {one["name"] for one in told["signals"]} == {"tank", "heater", "fan", "room", "room_again"}
    states = {item["name"]: item for item in told["states"]}
    assert set(states) == {"tank", "room"} and set(told["inputs"]) == {"heater", "fan"}
    assert set(states["tank"]["follows"]) == {"heater", "fan"}
    assert set(states["room"]["sensors"]) == {"room", "room_again"}
    score = nisus("fold", str(out), "--json").json
    assert score["readings"] == 12_000 and score["failed"] == 0
    assert 0.7 < score["nis"]["mean"] < 1.3
    page = nisus("advise", str(out)).out
    assert "Use kf, Kalman filter (as now)" in page and "\n  estimator: kf  #" in page
    assert "every band is right within a quarter, and no correlation is beyond 0.2 (3 rows)" in " ".join(page.split())


def test_the_page_of_a_recording_says_what_was_found(table, nisus):
    page = nisus("advise", str(table)).out
    assert "room_again = 0.9" in page or "room_again = 1" in page
    assert "noise, so two sensors of one state" in " ".join(page.split())
    assert "tank: follows heater, fan" in page and "Write the draft with --out NAME.yaml" in page


def test_options_of_the_other_kind_are_refused(table, nisus):
    assert "are for a twin" in nisus.refuses("advise", str(table), "--apply")
    assert "--inputs and --hold-out are for recordings" in nisus.refuses("advise", "motor_winding", "--dbc", "car.dbc")
    assert "one twin at a time" in nisus.refuses("advise", "motor_winding", "motor_can")


def test_signals_have_the_roles_that_they_are_given(table, nisus):
    out = table.with_name("boiler.yaml")
    roles = ("--sensors", "tank,room*", "--inputs", "heater,fan", "--hold-out", "room_again")
    nisus("new", "boiler", "--folder", str(table.parent), "--log", str(table), *roles)
    found = load_twin(out)
    assert found.model.input_names == ("heater", "fan")
    used = dict(zip(found.model.sensor_names, found.tuning.used, strict=True))
    assert used == {"tank": True, "room": True, "room_again": False}
    assert "did you mean heater" in nisus.refuses("advise", str(table), "--inputs", "heatr")
    assert "room is input as well" in nisus.refuses("advise", str(table), "--sensors", "room", "--inputs", "room")
    # Nothing else measures the tank, and without an input nothing drives it.
    assert "nothing predicts it" in nisus.refuses("advise", str(table), "--sensors", "room", "--hold-out", "tank")
