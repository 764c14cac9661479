"""Drafts of recordings whose rows repeat a value: the noise and the band are those of the measurements."""

import struct

import numpy as np
import pytest

from app.study.advice.measured import repeat_lines, repeats_of
from config.yaml_files import parse
from estimators.models.motor_drive import MOTOR_WINDING
from tests.sources.can.can_tools import dbc
from tests.support import measured

Q, STD = 0.02, 0.5


def truth_and_values(seed, n, period: int):
    """A random walk each second, n periods long, and one measurement each period."""
    rng = np.random.default_rng(seed)
    x = 50.0 + np.cumsum(rng.normal(0.0, np.sqrt(Q), n * period))
    return x, np.round(x[::period] + rng.normal(0.0, STD, n), 2)


def table(folder, values, truth: np.ndarray):
    rows = np.column_stack((np.arange(truth.size), values, truth))
    np.savetxt(folder / "log.csv", rows, delimiter=",", header="t,temp,ref", comments="", fmt="%.6g")
    return folder / "log.csv", "temp: {columns: ref}", ()


def held(folder):
    """One measurement every 10 s, in rows of 1 s."""
    truth, y = truth_and_values(1, 120, 10)
    return table(folder, np.repeat(y, 10), truth)


def raw(folder):
    """The same measurements alone, in rows of 1 s."""
    truth, y = truth_and_values(1, 120, 10)
    values = np.full(truth.size, np.nan)
    values[::10] = y
    log, wanted, more = table(folder, values, truth)
    log.write_text(log.read_text().replace(",nan,", ",,"))
    return log, wanted, more


def can(folder):
    """A frame at 20 Hz, whose value changes once a second."""
    truth, y = truth_and_values(2, 600, 1)
    lines = []
    for k in range(20 * truth.size):
        lines.append(
            f"({100.0 + 0.05 * k:.6f}) can0 100#{struct.pack('<H', round((y[k // 20] + 40.0) * 10)).hex()}0000"
        )
        if k % 20 == 0:
            lines.append(f"({100.0 + 0.05 * k:.6f}) can0 80000200#{struct.pack('<d', truth[k // 20]).hex()}")
    (folder / "log.log").write_text("\n".join(lines) + "\n")
    return folder / "log.log", "temp: {message: WIDE, signals: Ratio}", ("--dbc", dbc(folder))


@pytest.mark.parametrize(
    ("make", "key", "number"), [(held, "every 10 s", 120), (raw, None, 120), (can, "every 1 s", 600)]
)
def test_a_draft_has_the_noise_and_the_band_of_the_measurements(make, key, number, tmp_path, nisus):
    log, truth, more = make(tmp_path)
    sensors = "Temp" if more else "temp"
    nisus("new", "slow", "--log", log, *more, "--sensors", sensors, "--folder", tmp_path)
    text = (tmp_path / "slow.yaml").read_text()
    data, _ = parse(text, "slow.yaml")
    assert data["source"]["sensors"]["temp"].get("repeats") == key
    assert key is None or f"repeats: {key}}}  # new value {key}, repeated in 9" in text
    assert 0.4 < data["sensors"]["temp"]["std"] < 0.7
    # Codes of 0.1 are coarse beside the noise, so the sensor may be off by one of them.
    assert data["sensors"]["temp"].get("offset") == ({"std": 0.1} if more else None)
    score = nisus("fold", tmp_path / "slow.yaml", "--set", f"source.truth={{{truth}}}", "--json").json
    assert score["readings"] == number and score["missing"] == 0
    assert 0.90 < score["coverage"]["temp"] < 0.98


def test_interpolated_rows_are_refused_or_left_out(tmp_path, nisus):
    truth, y = truth_and_values(1, 121, 10)
    log, *_ = table(tmp_path, np.interp(np.arange(truth.size), np.arange(121) * 10, y), truth)
    why = "interpolated or computed in 90 % of rows, straight between values every 10 s"
    line = nisus.refuses("new", "slow", "--log", log, "--sensors", "temp", "--folder", tmp_path)
    assert line.startswith(f"nisus: temp: {why}; a sensor needs the values themselves")
    assert f"temp: {why}" in nisus("log", log).out
    told = {one["signal"]: one for one in nisus("advise", log, "--json").json["roles"]}
    assert (told["temp"]["role"], told["temp"]["reason"], told["ref"]["role"]) == ("omitted", why, "sensor")


def test_the_measurements_of_a_twin_are_looked_at():
    model = MOTOR_WINDING
    log = measured(model, "winding", np.arange(600.0), np.repeat(truth_and_values(1, 60, 1)[1], 10))
    assert repeat_lines(repeats_of(model, log)) == [
        "winding: new value every 10 s, repeated in 90 % of rows; give its channel in `source` the key repeats: "
        "every 10 s, and tune again"
    ]
