"""A draft is fitted to the first half of a recording, or to every other eighth; its check is a fold of its YAML."""

import re
from pathlib import Path

import numpy as np
import pytest

from app.study.advice.draft import python_text
from app.study.advice.draft_check import ModelFiles, log_of
from app.study.advice.draft_fit import fit_all
from app.study.advice.plan import OMITTED, Moves, Reads, Roles, plan
from app.study.advice.relations import driven
from app.study.advice.signals import signal
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.fit.objective import FitProgress
from estimators.fold import folded
from estimators.log import READING
from estimators.tuning import Tuning
from sources.inspect import RecordingContents, SignalSeries, inspect_recordings

N = 3000
"""Rows, one a second. Of the 1,500 in the second half a share of 95 % has a standard deviation of 0.6 %."""


def write(path, **columns):
    table = {"t": np.arange(N) * 1.0, **columns}
    np.savetxt(path, np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
    return path


def second_half(twin, log):
    """Return the innovations in σ of each sensor from the median time of measurements on, by a fold of the YAML."""
    fold = twin.fold(log)
    fold.advance()
    rows = log.events.kind == READING
    late = log.events.t >= np.median(log.events.t[rows])
    e = fold.track.innovation[:, 0] / fold.track.innovation_std[:, 0]
    return {name: e[rows & late & (log.events.channel == k)] for k, name in enumerate(twin.model.sensor_names)}


def test_three_wheels_are_sensors_of_one_speed_and_the_check_is_a_fold_of_the_yaml(tmp_path, nisus):
    rng = np.random.default_rng(7)
    speed = 60.0 + np.cumsum(rng.normal(0, 0.4, N))
    wheels = {f"wheel_{k}": gain * speed + rng.normal(0, 0.2, N) for k, gain in enumerate((1.0, 1.01, 0.995))}
    log = write(tmp_path / "drive.csv", **wheels, pressure=np.full(N, 2.5), gear=np.arange(N) // 500 % 3)
    told = nisus("new", "drive", "--folder", str(tmp_path), "--log", str(log), "--json").json
    assert [one["role"] for one in told["roles"]] == ["sensor", "sensor", "sensor", "omitted", "omitted"]
    text = (tmp_path / "drive.yaml").read_text()
    assert "# Omitted 1 (constant): pressure" in text and "few different values): gear" in text
    check = told["check"]
    assert check["consistent"]
    # `fold` of the same rows has the same verdict; the YAML has three digits of each noise.
    folded = nisus("fold", tmp_path / "drive.yaml", "--since", "50%", "--json").json
    assert 0.0 <= folded["start"] - check["start"] < 1.0  # the first event of the second half
    assert [folded["nis"][key] for key in ("mean", "low", "high")] == pytest.approx(
        [check[key] for key in ("nis", "low", "high")], rel=0.02
    )
    twin = load_twin(tmp_path / "drive.yaml")
    late = second_half(twin, read_log(twin, None)[0])
    # The YAML has three digits of each standard deviation: half a per cent of a NIS.
    assert check["nis"] == pytest.approx(np.mean([np.mean(e**2) for e in late.values()]), rel=0.02)
    for one in check["sensors"]:
        assert one["n"] == late[one["name"]].size == N // 2
        assert one["coverage"] == pytest.approx(np.mean(np.abs(late[one["name"]]) <= 1.96), abs=0.003)
        assert 0.93 < one["coverage"] < 0.97
        without = load_twin(tmp_path / "drive.yaml", overrides={f"sensors.{one['name']}.use": "false"})
        e = second_half(without, read_log(without, None)[0])[one["name"]]
        assert one["held_out"] == pytest.approx(np.mean(np.abs(e) <= 1.96), abs=0.003)
        assert 0.90 < one["held_out"] < 0.98


LATE = np.arange(N) >= N // 2


@pytest.mark.parametrize(("step", "noise"), [((0.1, 1.0), (0.3, 0.3)), ((0.05, 0.05), (0.3, 3.0))])
def test_an_asset_whose_halves_differ_is_fitted_to_parts_of_both(tmp_path, step, noise):
    """It moves faster, or its sensor worsens; fitted to the first half alone, its bands are too narrow in the other."""
    rng = np.random.default_rng(12)
    level = np.cumsum(np.where(LATE, *step[::-1]) * rng.normal(size=N))
    level += np.where(LATE, *noise[::-1]) * rng.normal(size=N)
    found = inspect_recordings([write(tmp_path / "tank.csv", level=level)])
    drafted = fit_all(plan(found, Roles()))
    check = drafted.check
    assert check.parts == 8 and not check.reason and check.low <= check.nis <= check.high
    # No one noise fits both.
    assert drafted.options["adapt"] == "Q"
    # Every other eighth of the measurements was fitted.
    assert check.sensors[0].n == N // 2 and check.start == pytest.approx(N / 8, abs=1.0)
    assert 0.93 < check.sensors[0].coverage.value < 0.97
    parts = "Fitted to every other of 8 parts (about 6.25 min each), checked on the others"
    assert check.fitted_to == f"The halves of the recording differ. {parts}"


def test_a_fit_that_is_stopped_keeps_the_draft_and_checks_it(tmp_path):
    rng = np.random.default_rng(9)
    found = inspect_recordings([write(tmp_path / "tank.csv", level=np.cumsum(rng.normal(0, 1, N)))])
    begun = plan(found, Roles())
    progress = FitProgress(stop=True)
    stopped = fit_all(begun, progress=progress)
    assert [item.q for item in stopped.states] == [item.q for item in begun.states]
    assert progress.folds == 1 and stopped.check.sensors[0].n == N // 2


def test_every_signal_of_a_recording_has_a_role_or_a_reason(tmp_path):
    rng = np.random.default_rng(10)
    walks = {f"x{k}": np.cumsum(rng.normal(0, 1, N)) for k in range(8)}
    found = inspect_recordings([write(tmp_path / "many.csv", **walks, counter=np.arange(N))])
    roles = plan(found, Roles()).roles
    assert [one.signal.name for one in roles] == [*walks, "counter"]
    omitted = {one.signal.name: one.reason for one in roles if one.role == OMITTED}
    assert len(omitted) == 3 and omitted.pop("counter") == "time, counter or status"
    assert set(omitted.values()) == {"not among the 6 signals with most different values"}


def test_no_time_constant_is_beyond_the_recording():
    """A tank that warms with 3,590 s is recorded for 1,147 s: the recording does not show where it ends."""
    t = np.arange(1147)
    rng = np.random.default_rng(11)
    heater = np.where(t < 50, 0.0, 1.0) + rng.normal(0, 0.01, t.size)
    tank = 20.0 + 60.0 * (1.0 - np.exp(-np.maximum(t - 50, 0) / 3590.0)) + rng.normal(0, 0.02, t.size)
    found = [signal(None, SignalSeries(name, "", t * 10**9, x)) for name, x in (("tank", tank), ("heater", heater))]
    lag = driven(found, 0, [1])
    assert lag is None or lag.tau <= 1147 / 3


def test_rows_of_two_sources_in_turn_are_not_consistent_though_their_nis_is(tmp_path):
    """Nothing names the source of a row: each innovation is followed by one of the other sign."""
    rng = np.random.default_rng(11)
    level = np.cumsum(rng.normal(0, 0.1, N)) + np.where(np.arange(N) % 2, 1.0, -1.0) + rng.normal(0, 0.1, N)
    found = inspect_recordings([write(tmp_path / "tank.csv", level=level)])
    check = fit_all(plan(found, Roles())).check
    assert check.sensors[0].correlation.high < -0.2 and 0.90 < check.sensors[0].coverage.value
    assert check.reason.startswith("successive innovations of level alternate (-0.") and check.words.startswith(
        "not con"
    )


def test_two_rows_at_nearly_one_time_do_not_make_a_prior_that_diverges(tmp_path):
    """Rows of a clock that was set back were sorted between the others, a microsecond from their neighbours."""
    rng = np.random.default_rng(14)
    t = np.arange(N) * 1.0
    t[1000:1003] = t[900:903] + 1e-6
    level = 30.0 + 20.0 * np.sin(t / 40.0) + rng.normal(0, 0.3, N)
    drafted = fit_all(
        plan(inspect_recordings([write(tmp_path / "tank.csv", t=t, level=level)]), Roles(states=("level",)))
    )
    check = drafted.check
    assert drafted.states[0].smooth
    # The curve moves by at most 20/40 a second, its noise by 0.3 √2 from one row to the next.
    text = python_text("tank", "Tank", drafted)
    std = float(re.search(r'"level_rate".*std=([\d.e+-]+)', text)[1])
    assert 0.3 < std < 1.0
    assert check.sensors[0].n == N // 2 and 0.9 < check.nis < 1.1


def test_bands_that_are_too_wide_alone_are_conservative(tmp_path):
    """The noise of a held-out sensor is uniform: none of it is beyond √3 σ, so the 95 % band contains all of it."""
    rng = np.random.default_rng(15)
    level = np.cumsum(rng.normal(0, 0.3, N))
    columns = {"level": level + rng.normal(0, 0.3, N), "second": level + rng.uniform(-4.0, 4.0, N)}
    found = inspect_recordings([write(tmp_path / "tank.csv", **columns)])
    check = fit_all(plan(found, Roles(sensors=("level",), held_out=("second",)))).check
    coverage = {one.name: one.coverage.value for one in check.sensors}
    assert coverage["second"] > 0.98 and coverage["level"] > 0.9
    assert check.wide and check.words.startswith("conservative: ")


def test_a_long_recording_is_checked_in_windows():
    """Of a walk of half a million rows the check takes windows of both halves, and finds it consistent."""
    rng = np.random.default_rng(3)
    n = 500_000
    t = np.arange(n) * 10**8
    walk = np.cumsum(rng.normal(0.0, 0.05, n)) + rng.normal(0.0, 0.1, n)
    found = RecordingContents([Path("walk.csv")], "table", t, columns=[SignalSeries("level", "m", t, walk)])
    check = fit_all(plan(found, Roles())).check
    assert check.windows == 16 and check.reason == ""
    assert (
        check.fitted_to == "Fitted to the first 6.94 h, checked on the other 6.94 h (in 16 windows over the recording)"
    )
    assert check.sensors[0].n == 8 * 6_250
    assert check.sensors[0].coverage.value == pytest.approx(0.95, abs=0.005)


def test_windows_of_one_log_are_folded_as_logs_of_their_own(tmp_path):
    """The log-likelihood of two windows, far from each other, is the sum of those of a log of each."""
    t = np.arange(1000) * 10**8
    values = np.cumsum(np.random.default_rng(4).normal(0.0, 0.2, 1000))
    one = signal(None, SignalSeries("level", "m", t, values))
    reads = Reads("level", one, 0.01)
    item = Moves("level", one, False, 0.4, (reads,))
    model = ModelFiles(tmp_path).model([item], [])
    windows = [(0, 100 * 10**8), (700 * 10**8, 900 * 10**8)]

    def density(*parts: tuple[int, int]) -> float:
        fold = folded("kf", model, Tuning.of(model), log_of(model, [reads], [], parts, 0))
        return float(np.nansum(fold.track.log_likelihood))

    assert density(*windows) == pytest.approx(sum(map(density, windows)), abs=1e-6)


def test_a_coarse_sensor_of_a_state_that_follows_an_input_has_an_offset_beside_the_lag(tmp_path, nisus):
    rng = np.random.default_rng(5)
    power = np.where(np.arange(N) // 300 % 2, 100.0, 20.0)
    wall = np.zeros(N)
    for k in range(1, N):
        wall[k] = wall[k - 1] + (20.0 + 0.3 * power[k - 1] - wall[k - 1]) / 60.0
    wall = np.round(wall + rng.normal(0, 0.02, N), 1)
    log = write(tmp_path / "wall.csv", wall=wall, power=power)
    nisus("new", "plant", "--folder", tmp_path, "--log", str(log), "--sensors", "wall", "--inputs", "power")
    assert "wall_base" in (tmp_path / "plant.py").read_text()
    assert "offset: {std: 0.1}" in (tmp_path / "plant.yaml").read_text()
    assert nisus("fold", tmp_path / "plant.yaml", "--json").json["readings"] == N
