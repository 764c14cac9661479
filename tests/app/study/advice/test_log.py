"""The advice on a bare recording: noise, pairs and lags are found as they were put there; a draft that runs."""

import numpy as np
import pytest

from app.study.advice.draft import hint_lines, write_draft
from app.study.advice.plan import Roles, plan
from app.study.advice.relations import driven, pairs
from app.study.advice.signals import comes_by_chance, noise_of, rough, signal
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.log import READING
from sources.inspect import SignalSeries, inspect_recordings


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


def test_a_clock_is_no_signal_and_three_times_at_one_interval_are_not_needed():
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.9, 1.1, 300))
    when = np.round(t * 1e9).astype(np.int64)
    assert signal(None, SignalSeries("a", "", when, 5e5 + np.round(1e3 * t))).kind == "counter"
    assert signal(None, SignalSeries("a", "", when, 2.0 * t)).kind == "signal"
    # Numbers of the rows, a counter of four bits, and whole numbers that wander.
    rows = np.arange(300.0)
    for values, kind in (
        (rows + 7.0, "counter"),
        (rows % 16, "counter"),
        (np.cumsum(rng.integers(-1, 3, 300)), "signal"),
    ):
        assert signal(None, SignalSeries("a", "", when, values)).kind == kind
    # Pairs of rows, a quarter of a second and then some seconds apart: no two successive intervals are alike.
    pairs = np.cumsum(np.where(np.arange(300) % 2, 0.25, rng.uniform(3.0, 5.0, 300)))
    walk = SignalSeries("a", "", np.round(pairs * 1e9).astype(np.int64), np.cumsum(rng.normal(0, 1, 300)))
    for smooth in (False, True):
        assert all(0.0 < noise < 1e3 for noise in noise_of(walk, smooth)[1:])


def test_a_signal_comes_by_chance_that_is_away_while_others_are_not_and_without_a_rate():
    """Away for 5 s, twelve times; as the whole recording; once more for long; at a slower rate."""
    seen, slower = (np.cumsum([*gaps] * 12).astype(int) for gaps in ([1e8] * 40 + [5e9], [1e8] * 40 + [5e9] * 9))
    always = np.arange(0, slower[-1], 10**8)
    cases = (seen, always), (seen, seen), (np.delete(seen, slice(50, 300)), seen), (slower, always)
    found = [comes_by_chance(signal(None, SignalSeries("a", "", t, t % 7.0)), recorded) for t, recorded in cases]
    assert found == [True, False, False, False]


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
    told = nisus("advise", str(table), "--json").json
    nisus("new", "boiler", "--folder", str(table.parent), "--log", str(table))
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
    assert "tank: follows heater, fan" in page and "nisus new NAME --log FILE writes the draft" in page


def test_options_of_the_other_kind_are_refused(table, nisus):
    for option in (["--apply"], ["--out", "tank.yaml"]):
        assert "are for a twin; nisus new NAME --log FILE" in nisus.refuses("advise", str(table), *option)
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


def drafted(path, *files, **roles):
    """The twin of a draft that was not fitted, its log, and the plan."""
    found = inspect_recordings(files)
    planned = plan(found, Roles(**roles))
    twin = load_twin(write_draft(planned, found, "own", path).yaml_path)
    return twin, read_log(twin, None)[0], planned


def of_sensor(log, twin, name):
    rows = (log.events.kind == READING) & (log.events.channel == twin.model.sensor_names.index(name))
    return log.events.t[rows], log.events.value[rows, 0]


def csv(path, **columns):
    rows = zip(*columns.values(), strict=True)
    path.write_text(",".join(columns) + "\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


@pytest.mark.parametrize(
    ("heading", "count"), [("wheel_kmh", 1), ("wheel_speed", 1), ("Wheel [km/h]", 1), ("Wheel [kPa]", 2)]
)
def test_one_speed_in_two_units_is_one_state_with_two_sensors(tmp_path, heading, count):
    """GNSS in m/s and a wheel in whole km/h, 0.6 % larger: by the unit, or by a usual ratio and a word in common."""
    rng = np.random.default_rng(4)
    t = np.arange(1200.0)
    speed = 15.0 + np.cumsum(rng.normal(0, 0.3, t.size))
    wheel = np.round(3.6 * 1.006 * speed + np.convolve(rng.normal(0, 0.3, t.size + 2), np.ones(3), "valid"))
    gnss = np.round(speed + rng.normal(0, 0.05, t.size), 3)
    log = csv(
        tmp_path / "drive.csv", t=t, **{"gnss_speed_mps" if "_" in heading else "gnss [m/s]": gnss, heading: wheel}
    )
    planned = plan(inspect_recordings([log]), Roles(sensors=("*",)))
    assert len(planned.states) == count
    if count == 1:
        _, other = planned.states[0].sensors
        assert other.gain == pytest.approx(3.6 * 1.006, rel=0.005)


@pytest.mark.parametrize(("name", "ids"), [("anchor_id", ("3", "17")), ("Tag", ("TT101", "PT-2"))])
@pytest.mark.parametrize("sorted_by", ["time", "source"])
def test_rows_of_several_sources_are_sensors_that_by_tells_apart(tmp_path, name, ids, sorted_by):
    rng = np.random.default_rng(6)
    values = np.round(np.cumsum(rng.normal(0, 1, (2, 200)), axis=1) + [[20.0], [500.0]], 3)
    rows = [(t, ids[k], values[k, t]) for t in range(200) for k in range(2)]
    if sorted_by == "source":
        rows.sort(key=lambda row: row[1])
    log = csv(tmp_path / "plant.csv", **dict(zip(("t", name, "value"), zip(*rows, strict=True), strict=True)))
    twin, read, planned = drafted(tmp_path, log)
    assert [one.role for one in planned.roles if one.signal.series.only] == ["sensor", "sensor"]
    assert 'value: {columns: "value", landmark_column: ' in twin.path.read_text()
    for k, sensor in enumerate(sorted(twin.model.sensor_names, key=lambda sensor: not sensor.endswith(("3", "101")))):
        t, found = of_sensor(read, twin, sensor)
        assert t.tolist() == [s * 10**9 for s in range(200)] and found.tolist() == values[k].tolist()


def test_files_with_different_columns_become_the_parts_of_a_merged_source(tmp_path):
    """The receiver is without a fix for 5 s, five times."""
    rng = np.random.default_rng(7)
    always = np.arange(600) * 0.1
    seen = np.arange(300) * 0.1 + 5.0 * (np.arange(300) // 50) + 0.03
    one, other = (np.round(np.cumsum(rng.normal(0, 1, t.size)), 3) for t in (always, seen))
    files = (
        csv(tmp_path / "odometry.csv", t_s=always, speed=one),
        csv(tmp_path / "gnss.csv", time=seen, north=other, Fix=np.ones(300)),
    )
    twin, log, _ = drafted(tmp_path, *files)
    assert twin.loaded.config.source.type == "merged"
    assert [sensor.by_chance for sensor in twin.model.sensors] == [False, True]
    for name, values, times in (("speed", one, always), ("north", other, seen)):
        t, found = of_sensor(log, twin, name)
        np.testing.assert_allclose(t * 1e-9, times, atol=1e-9)
        assert found.tolist() == values.tolist()


def test_values_beside_a_flag_of_validity_are_used_where_it_is_set(tmp_path):
    """A receiver without a fix reports zero, which would hide that two sensors measure the same."""
    rng = np.random.default_rng(8)
    speed = np.round(20.0 + np.cumsum(rng.normal(0, 0.2, 500)), 3)
    valid = (np.arange(500) > 80).astype(int)
    log = csv(tmp_path / "drive.csv", t=np.arange(500), speed_gnss=np.where(valid, speed, 0.0), speed_valid=valid)
    twin, read, planned = drafted(tmp_path, log)
    _, found = of_sensor(read, twin, "speed_gnss")
    np.testing.assert_array_equal(found, np.where(valid, speed, np.nan))
    assert planned.states[0].signal.series.values.tolist() == speed[81:].tolist()


@pytest.mark.parametrize("size", [0.0, 3.0])
def test_a_cycle_of_days_is_found_and_a_random_walk_has_none(tmp_path, size):
    rng = np.random.default_rng(9)
    hours = np.arange(24 * 60.0)
    value = 20.0 + np.cumsum(rng.normal(0, 0.3, hours.size)) + size * np.sin(2 * np.pi * hours / 24 + 1.0)
    log = csv(tmp_path / "room.csv", t=hours * 3600, value=np.round(value, 3))
    planned = plan(inspect_recordings([log]), Roles())
    (item,) = planned.states
    if not size:
        assert item.cycle is None and not hint_lines(planned)
        return
    # A line of 60 cycles is known to 1/60 of its period at worst; the walk hides a few per cent of the amplitude.
    assert item.cycle == (pytest.approx(86400, rel=1 / 60), pytest.approx(size, rel=0.1))
    assert hint_lines(planned)[0].startswith("Cycles that the draft does not know: value every 24 h (amplitude ")


def test_an_input_that_explains_nothing_is_said_to_be_unused(tmp_path):
    rng = np.random.default_rng(10)
    walks = {name: np.round(np.cumsum(rng.normal(0, 1, 400)), 3) for name in ("level", "valve")}
    planned = plan(inspect_recordings([csv(tmp_path / "t.csv", t=np.arange(400), **walks)]), Roles(inputs=("valve",)))
    assert hint_lines(planned) == [
        "Input valve is not used: no first-order lag behind it explains half of the variance of a state. Write its "
        "effect into step(), or omit it."
    ]
