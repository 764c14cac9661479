"""Limits and ranges of validity as a twin's YAML says them: what they come to, what is refused, what is told of it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from app.cli.arguments import FoldCommand as Arguments
from app.cli.fold import fold_twin
from app.engine.counts import RowCounts
from app.engine.failure_notices import rejections
from app.engine.fold_json import base_from_json, base_to_json
from app.twin.model import configure
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from estimators.model.parts import Limits, Stuck
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases
from tests.support import folded, measured

pytestmark = pytest.mark.usefixtures("inside")

TWIN = """\
model: motor_winding
estimator: kf
sensors:
  winding:
    std: 0.5
    {limits}
{more}
source:
  type: table
  files: log.csv
  time: {{column: t, unit: s}}
  sensors:
    winding: {{columns: T, where: {{ok: 1}}}}
"""


def limited(limits, more=""):
    return TWIN.format(limits=limits, more=more)


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ("range: [-40, 180]", Limits(range=((-40.0, 180.0),))),
        ("range: [[-40, null]]", Limits(range=((-40.0, np.inf),))),
        ("saturation: [null, 250]", Limits(saturation=((-np.inf, 250.0),))),
        ("rate: 5", Limits(rate=(5.0,))),
        ("stuck: {readings: 20, quantum: 0.1}", Limits(stuck=Stuck(readings=20, quantum=(0.1,)))),
        ("stuck: {quantum: 0.5, std: 0.2}", Limits(stuck=Stuck(quantum=(0.5,), std=(0.2,)))),
        ("duplicates: {within: 0.05}", Limits(duplicates=0.05)),
        ("use: true", None),
    ],
)
def test_limits_reach_the_sensor(limits, expected):
    assert twin_of(limited(limits)).model.sensors[0].limits == expected
    fahrenheit = {"source.sensors.winding": "{message: THERMAL, signals: WindingTemp, scale: 2, offset: 1, units: K}"}
    (ends,) = load_twin("motor_can", overrides=fahrenheit).model.sensors[0].limits.ends
    assert ends == pytest.approx((2 * (-50 - 273.15) + 1, 2 * (605.35 - 273.15) + 1))


def test_ranges_take_the_place_of_the_models():
    valid = "valid_range: {temperature: {range: [0, 150], extrapolate: 20}}"
    twin = twin_of(limited("use: true", f"{valid}\npossible: {{rate: [-9, null]}}"))
    temperature, rate = twin.model.states
    assert (temperature.fitted, temperature.near, temperature.limits) == ((0.0, 150.0), 20.0, None)
    assert rate.limits == (-9.0, np.inf)
    # An absolute temperature is not negative, as its prior says; a difference of two may be.
    model, loaded = replace(twin.model, states=(replace(temperature, unit="K"), replace(rate, unit="K"))), twin.loaded
    loaded = replace(loaded, config=loaded.config.model_copy(update={"possible": {}}))
    assert [state.limits for state in configure(model, loaded).states] == [(0.0, np.inf), (-9.0, np.inf)]


@cases(__file__, "limits.csv")
def test_what_means_nothing_is_refused_with_its_place(limits, more, said):
    with pytest.raises(ConfigError, match=said):
        twin_of(limited(limits, more))


def test_a_quantum_says_nothing_of_a_sensor_without_noise():
    text = limited("stuck: {quantum: 0.1}").replace("std: 0.5", "std: 0")
    assert "gives a quantum alone, which needs a sensor with noise" in refusal(text)


def log_with_faults():
    """A log of 60 s: 10 of them not valid, three out of range, of which one is written twice, and a jump."""
    rng = np.random.default_rng(1)
    values = 30 + rng.normal(0, 0.5, 60)
    values[[20, 21, 22]] = 500.0, -300.0, 500.0
    values[40] = 60.0
    rows = [f"{t},{y:.6f},{int(not 5 <= t < 15)}" for t, y in enumerate(values)]
    rows.insert(21, rows[20])
    Path("log.csv").write_text("\n".join(["t,T,ok", *rows]) + "\n")


def test_what_was_refused_is_counted_told_and_kept(capsys):
    log_with_faults()
    path, out = "motor.yaml", Path("out.parquet")
    twin_of(limited("range: [-40, 180]\n    rate: 5"))
    assert fold_twin(Arguments(path, json=True)) == 0
    told = json.loads(capsys.readouterr().out)
    # The spikes are both out of range and too fast.
    expected = {"range": 3, "rate": 4, "duplicate": 1, "condition": 10}
    assert told["screened"] == {"winding": expected}
    assert fold_twin(Arguments(path, out=out)) == 0
    text = capsys.readouterr().out
    assert "not used of winding" in text and "range 3, rate 4, duplicate 1, condition 10" in text
    table = pq.read_table(out).to_pandas()
    reasons = table["screened"].value_counts().to_dict()
    assert reasons == {"range, rate": 3, "rate": 1, "duplicate": 1}
    spikes = table[table["screened"] == "range, rate"]
    assert sorted(spikes["value_0"]) == [-300.0, 500.0, 500.0] and set(spikes["verdict"]) == {"screened"}


REASON_SECONDS = {"duplicate": 1, "range": 2, "rate": 3}


def test_counts_and_lines_name_sensor_value_and_rule():
    twin = twin_of(limited("range: [-40, 180]\n    rate: 5"))
    log = measured(twin.model, "winding", [0, 1, 1, 2, 3], [30, 30, 30, 500, 60])
    fold = folded("kf", twin.model, log)
    found = list(rejections(twin.model, log, fold.track, 0))
    lines = {key: text for key, text, _ in found}
    assert {key: t for key, _, t in found} == {f"{what} winding": k * 10**9 for what, k in REASON_SECONDS.items()}
    assert lines["duplicate winding"].startswith("winding: 30 °C came again; it counts once: look for what")
    assert lines["range winding"].startswith("winding: 500 °C is outside -40 to 180 °C; not used: look at the sensor")
    assert lines["rate winding"].startswith("winding: 60 °C is further from the last good reading than 5 °C/s allows;")
    assert len(lines) == 3
    counts = RowCounts(twin.model)
    found = counts.count(fold.track, log.channel)
    assert (found["screened"], found["used"]) == (3, 2)
    assert (found["duplicate winding"], found["range winding"], found["rate winding"]) == (1, 1, 2)


def test_a_base_keeps_what_the_screen_remembers():
    twin = twin_of(limited("rate: 5"))
    log = measured(twin.model, "winding", np.arange(100.0), np.full(100, 30.0))
    fold = folded("kf", twin.model, log)
    base = fold.base_at(100)[1]
    again = base_from_json(base_to_json(base))
    assert again is not None and base.edge is not None and again.edge is not None
    assert again.edge.tobytes() == base.edge.tobytes() and base.edge.any()


def test_copies_closer_than_a_simulated_sensors_period():
    """The asset tells its period: 4 steps of half a second."""
    text = """\
model: motor_winding
sensors: {winding: {duplicates: {within: %s}}}
source: {type: simulator, step: 0.5, duration: 10, sensors: {winding: {every: 4}}}
"""
    said = refusal(text % 2)
    assert said.startswith("motor.yaml:2: ") and "within is 2 s; it must be below the sensor's period (2 s)" in said
    assert twin_of(text % 1.9).model.sensors[0].limits == Limits(duplicates=1.9)
