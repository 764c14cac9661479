"""The table that `nisus fold --out` writes: a row an event, with what is true where it is known."""

import json
import re
import textwrap

import numpy as np
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from app.render.text import to_text
from app.study.compare import fold_row
from app.study.fold_result import ExplainedEpisode, dropped, episodes_topic
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.references import HALF_WIDTH
from estimators.fold import Fold as FoldOf
from estimators.interface.by_name import fold as fold_by_name
from estimators.models import MODELS
from estimators.track import HEALTH_NAMES
from estimators.tuning import Tuning
from tests.app.render.test_report import data_of
from tests.cases import cases
from tests.support import measured

DRIVE = """\
model: motor_winding
source:
  type: table
  files: drive.csv
  time: {column: t, unit: s}
  sensors: {winding: {columns: y}}
  truth: {temperature: {columns: temperature}, rate: {columns: rate}}
"""
BARE = DRIVE[: DRIVE.index("  truth")]  # without true states
ROWS = "t,y,temperature,rate\n0,40,41,0.5\n1,40,,0.25\n2,41,42,\n"


def drive(folder, rows=ROWS, text=DRIVE):
    """A recording and its twin."""
    (folder / "drive.csv").write_text(rows)
    (folder / "drive.yaml").write_text(text)
    return folder / "drive.yaml"


def test_true_states_have_columns_of_their_own(tmp_path, nisus):
    path = drive(tmp_path)
    out = tmp_path / "track.parquet"
    nisus("fold", path, "--out", out, "--json")
    table = pq.read_table(out)
    truth = np.array(table["event"].to_pylist()) == "truth"
    nan = np.nan
    for name, expected in (("temperature", [41.0, nan, 42.0]), ("rate", [0.5, 0.25, nan])):
        column = table[f"{name}_true"].to_numpy()
        np.testing.assert_array_equal(column[truth], expected)
        assert np.isnan(column[~truth]).all() and np.sum(~truth) == 3
    # The events as they were read are in the table too.
    log, _ = read_log(load_twin(path), None)
    np.testing.assert_array_equal(table["value_1"].to_numpy(), log.events.value[:, 1])


def test_an_estimate_with_too_wide_a_band_is_withheld(tmp_path, nisus):
    """The file has no value of it, and its band; so has no other state."""
    out = tmp_path / "track.parquet"
    nisus("fold", drive(tmp_path), "--out", out, "--json")
    bands = HALF_WIDTH * pq.read_table(out)["rate_std"].to_numpy()
    limit = 0.5 * float(bands.min() + bands.max())
    path = drive(tmp_path, text=f"{DRIVE}withhold: {{rate: {limit}}}\n")
    said = nisus("fold", path, "--out", out, "--json").json
    states = said["states"]
    table = pq.read_table(out).to_pandas()
    hidden = bands > limit
    assert 0 < hidden.sum() < len(table)
    np.testing.assert_array_equal(table["rate"].isna(), hidden)
    np.testing.assert_array_equal(HALF_WIDTH * table["rate_std"], bands)
    assert not table["temperature"].isna().any()
    np.testing.assert_array_equal(table["withheld"] == "rate", hidden)
    assert (states["rate"]["grade"] == "withheld") == hidden[-1]
    # Three rows, a second apart, of which the last has no time.
    seconds = np.diff(table["seconds"], append=table["seconds"].iloc[-1])
    assert states["rate"]["share"]["withheld"] == pytest.approx(seconds[hidden].sum() / seconds.sum())
    assert states["temperature"]["share"] == said["health"] | {"withheld": 0.0}
    assert all(sum(state["share"].values()) == pytest.approx(1.0) for state in states.values())


@pytest.mark.parametrize(
    ("limits", "grade", "why"),
    [
        ("[-10, 20]", "suspect", r"outside the fitted range \(temperature 4\d\.\d+ °C, fitted at -10 to 20"),
        ("[null, 20]", "suspect", "outside"),
        ("{range: [null, 20], extrapolate: 40}", "tracking", "too uncertain"),
    ],
)
def test_the_reason_of_a_withheld_estimate_names_what_left_the_fitted_range(tmp_path, nisus, limits, grade, why):
    """Which may have one end, and be extrapolated."""
    path = drive(tmp_path, text=DRIVE + f"withhold: {{rate: 1e-3}}\nvalid_range: {{temperature: {limits}}}\n")
    found = nisus("fold", path, "--json").json["states"]
    temperature, rate = found["temperature"], found["rate"]
    assert (temperature["grade"], rate["grade"]) == (grade, "withheld")
    assert ("outside" in temperature["reason"]) == (grade == "suspect") and re.match(why, rate["reason"])


@pytest.mark.parametrize("back", [3600.0, 1234.0])
def test_a_clock_that_steps_back_is_bridged_or_its_rows_are_sorted(tmp_path, nisus, back):
    """One line names it. Daylight saving time is bridged; any other step before the first row is files reversed."""
    y = 40.0 + np.random.default_rng(5).normal(0, 2, 200)
    rows = [f"{k - back * (k >= 100)},{value}\n" for k, value in enumerate(y)]
    path = drive(tmp_path, "t,y\n" + "".join(rows), BARE)
    said = nisus("fold", path)
    health = re.search(r"health at the end +(.*)", said.out)
    assert health is not None and re.search(r"readings +(\d+)", said.out)[1] == "200"
    assert health[1] == "tracking"
    if back == 1234.0:
        assert re.search(r"drive.csv:102: t is 1233 s before that of drive.csv:101; .* were sorted by t", said.err)
        return
    (line,) = [line for line in said.err.splitlines() if "clock was set" in line]
    assert "winding" in line and "3600 s back" in line


PARTS = """\
model: motor_winding
source:
  type: merged
  parts:
    - {type: table, files: drive.csv, time: {column: t, unit: s}, sensors: {winding: {columns: y}}}
    - type: table
      files: drive.csv
      time: {column: t, unit: s}
      truth: {temperature: {columns: temperature}, rate: {columns: rate}}
"""
SIMULATED = """\
model: motor_winding
source: {type: simulator, seed: 3, step: 1, duration: 200, sensors: {winding: {every: 2}}}
"""


@pytest.mark.parametrize("text", [DRIVE, PARTS, SIMULATED], ids=["table", "merged", "simulator"])
def test_a_blind_fold_ignores_the_truth_of_every_source(text, tmp_path, nisus):
    """The truth is 30 °C off, which figures report; nothing else changes without it, least of all health."""
    rng = np.random.default_rng(5)
    rows = "".join(f"{k},{40 + rng.normal(0, 2)},{70 if k > 5 else ''},\n" for k in range(100))
    path = drive(tmp_path, "t,y,temperature,rate\n" + rows, text)
    tables = {}
    for blind in ((), ("--blind",)):
        out = tmp_path / "track.parquet"
        found = nisus("fold", path, "--out", out, "--json", *blind).json
        tables[blind] = pq.read_table(out).to_pandas()
        assert bool(found["rmse"]) == bool(found["coverage"]) == (found["nees"] is not None) == (not blind)
        assert any(entry["role"] == "truth" for entry in found["calibration"]) == (not blind)
    seen, blind_table = tables[()], tables["--blind",]
    seen = seen[seen.event != "truth"].reset_index(drop=True)
    assert (seen.event == "reading").sum() >= 100 and (blind_table.event == "truth").sum() == 0
    for column in ("t_ns", "temperature", "temperature_std", "rate", "nis", "log_likelihood", "health"):
        np.testing.assert_array_equal(seen[column], blind_table[column])


def test_the_nees_is_that_of_the_python_interface(tmp_path, nisus):
    path = tmp_path / "drive.yaml"
    path.write_text(SIMULATED)
    log, _ = read_log(load_twin(path), None)
    expected = fold_by_name("kf", MODELS["motor_winding"], log, covariance=True).nees()
    found = nisus("fold", path, "--estimator", "kf", "--json").json["nees"]
    assert found["mean"] == pytest.approx(expected.mean, rel=1e-12)
    assert (found["low"], found["high"]) == pytest.approx(expected.mean_bounds, rel=1e-9)
    assert found["inside"] == expected.inside and found["n"] == expected.seconds.size == 200
    assert found["states"] == ["temperature", "rate"]
    assert found["low"] < found["mean"] < found["high"]
    text = nisus("fold", path, "--estimator", "kf").out
    assert re.search(rf"mean NEES +{found['mean']:.3g} +per degree of freedom, inside its 95 % bounds", text)
    # With a hundredth of the sensor's noise declared, the filter is overconfident.
    wrong = nisus("fold", path, "--estimator", "kf", "--set", "R.winding=0.09", "--json").json["nees"]
    assert wrong["mean"] > 3.0 * wrong["high"] and wrong["inside"] < 0.5


def stuck_drive(tmp_path):
    """200 readings, one a second, of which the last 100 are equal."""
    y = 40.0 + np.random.default_rng(5).normal(0, 2, 200)
    y[100:] = 46.5
    return drive(tmp_path, "t,y\n" + "".join(f"{k},{value}\n" for k, value in enumerate(y)), BARE)


def test_episodes_are_printed_told_to_scripts_and_kept(tmp_path, nisus):
    twin, out = str(stuck_drive(tmp_path)), tmp_path / "track.parquet"
    lines = nisus("fold", twin, "--out", out).out.splitlines()
    assert any(line.startswith("1 episode(s); docs/alarms.md") for line in lines)
    assert "stuck, at the end: winding is stuck at 46.5 °C since 100.0 s" in " ".join(" ".join(lines[-3:]).split())
    assert "winding is saturated at 46.5" in nisus("fold", twin, "--set", "sensors.winding.range=[0, 46.5]").out
    (episode,) = nisus("fold", twin, "--json").json["episodes"]
    assert {key: episode[key] for key in ("start", "end", "subject", "cause", "size", "low", "high", "unit")} == {
        "start": 100.0, "end": None, "subject": "winding", "cause": "stuck", "size": 46.5, "low": None, "high": None,
        "unit": "°C",
    }  # fmt: skip
    table = pq.read_table(out)
    assert (episode.pop("suspects"), episode.pop("likely")) == ([], "")  # a sensor that is stuck is no riddle
    assert json.loads(table.schema.metadata[b"episodes"]) == [episode]
    alarms, health = table["alarms"].to_pylist(), table["health"].to_pylist()
    assert alarms[:100] == [None] * 100 and "stuck" in alarms[-1].split(", ")
    # A sensor that tells nothing more degrades the twin, from the reading on with which it is known.
    known = next(k for k, causes in enumerate(alarms) if causes and "stuck" in causes)
    assert 100 < known < 130 and set(health[known:]) == {"degraded"}
    assert table["flags"].to_pylist() == [None] * 200


def test_of_many_episodes_the_first_are_printed():
    one = Episode(1.0, 2.5, "winding", "narrow", 2.0, 1.9, 2.1, "×", "bands of winding are too narrow")
    lines = to_text([episodes_topic([ExplainedEpisode(one, ())] * 25)]).splitlines()
    assert lines[1] == "  narrow, for 1.5 s: bands of winding are too narrow."
    assert len(lines) == 12 and "15 more" in lines[-1] and "--json" in lines[-1]
    assert len(to_text([episodes_topic([])]).splitlines()) == 1


BOX = """\
from estimators.model import Noise, Row, Sensor, State, StateSpaceModel


def f(X, u, p, dt):
    if dt > 1.5:
        raise ValueError("the step is too long")
    return X


def h(X, u, p):
    return X


Box = StateSpaceModel(
    name="box", title="box", states=(State("level", "m", 40.0, 5.0),), noises=(Noise("level", "m2/s", 0.1),),
    sensors=(Sensor("gauge", (Row("level", "m", 1.0),), h=h),), f=f, black_box=True,
)
"""
BOXED = """\
model: ./box.py:Box
estimator: filterpy-ukf
source: {type: table, files: drive.csv, time: {column: t, unit: s}, sensors: {gauge: {columns: y}}}
"""


def test_what_a_black_box_failed_with_is_told(tmp_path, nisus):
    """Of readings at 0, 1, 2, 4 and 5 s the last two are more than 1.5 s behind the last state that f reached."""
    (tmp_path / "drive.csv").write_text("t,y\n0,40\n1,40\n2,41\n4,41\n5,40\n")
    (tmp_path / "box.py").write_text(BOX)
    (tmp_path / "box.yaml").write_text(BOXED)
    path = str(tmp_path / "box.yaml")
    said = (
        f"{tmp_path / 'box.py'}:6: model box: f fails on a block of 3 states: ValueError: the step is too long; mend it"
    )
    printed = nisus("fold", path).out
    assert re.search(r"\n  failed +2: no estimate", printed)
    assert f"the model failed 2 time(s)  {said}" in printed
    told = nisus("fold", path, "--json").json
    assert told["failed"] == 2 and told["failure"].startswith(said)
    twin = load_twin(path)
    row = fold_row(twin, "filterpy-ukf", [read_log(twin, None)[0].events])
    assert row.failure.startswith(said)


def test_the_calibration_is_printed(tmp_path, nisus):
    """R as declared is 4; readings of a deviation of 3, and an estimate that is told to be 10 °C off at the end."""
    rng = np.random.default_rng(4)
    lines = [f"{t},{40 + 6 * rng.standard_normal()},{50 if t > 30 else ''}," for t in range(200)]
    path = drive(tmp_path, "\n".join(["t,y,temperature,rate", *lines]))
    head, *said = nisus("fold", path).out.partition("Calibration, 95 % intervals\n")[1:]
    assert head and re.search(r"^  winding: bands too narrow by a factor of 2\.\d \(scale 2\.\d\d, ", said[0])
    assert re.search(r"^  temperature: truth in its 95 % band \d\.?\d* % \(\S+ to \S+\) of the time$", said[0], re.M)


def test_what_of_the_model_made_a_reading_fail_is_told(tmp_path, nisus):
    """h ends at 42 m, beyond which the level rises: √ of a negative number."""
    box = """\
        import numpy as np
        from estimators.model import Noise, Row, Sensor, State, StateSpaceModel

        def f(x, u, p, dt, out):
            out[0] = x[0] + dt

        def h(x, u, p, out):
            out[0] = x[0] + 0.0 * np.sqrt(42.0 - x[0])

        Box = StateSpaceModel(
            name="box", title="box", states=(State("level", "m", 40.0, 0.01),), f=f,
            noises=(Noise("level", "m2/s", 1e-6),), sensors=(Sensor("gauge", (Row("level", "m", 1e-4),), h=h),),
        )
        """
    (tmp_path / "drive.csv").write_text("t,y\n0,40\n1,41\n2,41.9\n3,43\n")
    (tmp_path / "box.py").write_text(textwrap.dedent(box))
    (tmp_path / "box.yaml").write_text(BOXED.replace("filterpy-ukf", "ukf"))
    printed = nisus("fold", tmp_path / "box.yaml").out
    said = r"h\(x, u\) of sensor gauge is \[nan\] at x = \[4\d.*\], where the estimate got; it must be finite"
    assert re.search(rf"\n  because +{re.escape(str(tmp_path))}/box.py:7: model box: {said}", printed)
    assert re.search(said, nisus("fold", tmp_path / "box.yaml", "--json").json["failure"])


def test_the_json_says_what_a_script_needs(tmp_path, nisus):
    """Beside figures that are found from the events and the estimates in the table of `--out`."""
    rng = np.random.default_rng(2)
    t = np.arange(400) + 0.0
    true = 40.0 + 0.02 * t
    read = true + 3.0 * rng.standard_normal(t.size)
    read[50] = 200.0
    good = rng.random(t.size) > 0.1
    good[50] = True
    lines = [f"{a},{b},{c},0.02,{d:d}" for a, b, c, d in zip(t, read, true, good, strict=True)]
    # One reading in a row long after its time, where it is sorted to, and a silence of a minute at the end.
    lines += ["30.5,41.0,,,1", "460,49.0,49.2,0.02,1"]
    (tmp_path / "drive.csv").write_text("\n".join(["t,y,temperature,rate,good", *lines]))
    yaml = (
        DRIVE.replace("{columns: y}", "{columns: y, valid_if: {good: 1}}")
        + "gate: 0.9999\nsensors: {winding: {std: 3}}\n"
    )
    (tmp_path / "drive.yaml").write_text(yaml)
    figures = {}
    for used in (True, False):
        (tmp_path / "drive.yaml").write_text(yaml.replace("{std: 3}", f"{{std: 3, use: {str(used).lower()}}}"))
        out = tmp_path / "track.parquet"
        figures[used] = (
            nisus("fold", tmp_path / "drive.yaml", "--out", out, "--json").json,
            pq.read_table(out).to_pandas(),
        )
    told, table = figures[True]
    truth = table[table.event == "truth"]
    for state in ("temperature", "rate"):
        error = truth[state] - truth[f"{state}_true"]
        assert told["rmse"][state] == pytest.approx(np.sqrt(np.mean(error**2)))
        assert told["coverage"][state] == np.mean(np.abs(error) <= 1.959963984540054 * truth[f"{state}_std"])
    assert told["stale"] == 0 and told["readings"] == 402 and told["gated"] == 1
    assert told["conditioned"] == told["missing"] == np.sum(~good) > 20
    assert told["used"] == np.sum(good) + 1 == np.sum(table.verdict == "used")
    assert tuple(told["health"]) == HEALTH_NAMES
    # Beside the gap, in which the twin degrades and goes stale, all rows are tracking.
    policy = load_twin(tmp_path / "drive.yaml").policy
    heard = table[(table.verdict == "used") & (table.seconds < 400)].seconds.max()
    assert set(table.health[table.event != "tick"]) == {"tracking"} and heard + policy.stale_after < 460
    shares = {"degraded": policy.stale_after - policy.degraded_after, "stale": 460 - heard - policy.stale_after}
    shares["tracking"] = 460 - sum(shares.values())
    assert told["health"] == pytest.approx({name: shares.get(name, 0.0) / 460 for name in HEALTH_NAMES}, abs=1e-9)
    (gap,) = [item for item in told["episodes"] if item["cause"] == "stale"]
    assert (gap["start"], gap["end"], gap["size"]) == pytest.approx((heard, 460.0, 460.0 - heard))
    (tmp_path / "drive.yaml").write_text(yaml)
    shown = nisus("fold", tmp_path / "drive.yaml").out
    assert re.search(r"health, share of time +tracking \d+\.?\d* %, stale", shown)
    assert told["held_out"] == {}
    # The one that was refused lay at 160 °C, 50 deviations off: it costs at least log(1e4) beside its density.
    assert told["refused"] == pytest.approx(1 / (1 + told["used"]))
    used = table.verdict == "used"
    assert told["log_likelihood_used"] == pytest.approx(table.log_likelihood[used].sum())
    assert told["log_likelihood"] < told["log_likelihood_used"] - np.log(1e4)
    winding, temperature, rate = told["calibration"]
    assert (winding["subject"], winding["role"], winding["n"]) == ("winding", "used", told["used"] + 1)
    # Clipped at the gate, 3.89 deviations, the outlier adds 15.1 to the squares; one in 10,000 would be clipped anyway.
    e = (table.innovation_0 / table.innovation_std_0)[used]
    assert winding["ratio"]["value"] == pytest.approx((np.sum(e**2) + 15.137) / (e.size + 1), rel=1e-3)
    assert winding["refused"]["value"] == told["refused"] and winding["words"] == []
    assert (temperature["role"], rate["subject"], temperature["n"]) == ("truth", "rate", len(truth))
    assert temperature["coverage"]["95"]["value"] == told["coverage"]["temperature"]
    assert temperature["correlation"] == {"value": None, "low": None, "high": None}
    told, table = figures[False]
    rows = table[(table.event == "reading") & np.isfinite(table.value_0)]
    # What is held out is never used: the prediction is the temperature, as h says.
    error = rows.temperature - rows.value_0
    assert told["used"] == 0
    fit = told["held_out"]["winding"]
    assert fit["bias"] == pytest.approx(error.mean()) and abs(error.mean()) > 0.1
    assert fit["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)))
    inside = np.abs(error) <= 1.959963984540054 * np.sqrt(rows.temperature_std**2 + 9.0)
    assert fit["coverage"] == inside.mean()
    winding = told["calibration"][0]
    assert winding["role"] == "held out" and winding["coverage"]["95"]["value"] == inside.mean()


def test_what_was_dropped_is_said_if_it_was_much():
    model = MODELS["motor_winding"]
    log = measured(model, "winding", np.arange(10.0), np.full(10, 35.0))
    folded = FoldOf("kf", model, Tuning.of(model), log)
    folded.advance()
    assert dropped({}, folded) == [] and dropped({"stale": 0, "wrong time": 0}, folded) == []
    (episode,) = dropped({"stale": 80, "wrong time": 10}, folded)
    assert (episode.cause, episode.subject, episode.size, episode.end) == ("dropped", "twin", 0.9, None)
    assert episode.text.startswith("90 % of the measurements were dropped, 90 of 100:")


def test_what_is_smoothed_stands_beside_the_filter(tmp_path, nisus):
    path = drive(tmp_path)
    out = tmp_path / "track.csv"
    said = nisus("fold", path, "--out", out, "--smooth", "--json").json
    table = np.genfromtxt(out, delimiter=",", names=True, dtype=None, encoding=None)
    true = np.isfinite(table["temperature_true"])
    rmse = np.sqrt(np.mean((table["temperature_smooth"] - table["temperature_true"])[true] ** 2))
    assert said["smoothed"]["rmse"]["temperature"] == pytest.approx(rmse, rel=1e-12)
    assert np.all(table["temperature_smooth_std"] <= table["temperature_std"] * (1 + 1e-12))
    # What comes last is filtered with all that there is.
    assert table["rate_smooth"][-1] == table["rate"][-1] and table["rate_smooth"][0] != table["rate"][0]
    assert f"RMSE temperature, smoothed  {rmse:.5g} °C" in nisus("fold", path, "--smooth").out
    assert "filterpy-kf cannot be smoothed; use kf" in nisus.refuses(
        "fold", path, "--estimator", "filterpy-kf", "--smooth"
    )


def smoothed_lines(path):
    """Of a recording, (n, 3): the smoothed temperature, and the edges of its band, in the order of time."""
    rows = []
    for chunk in RrdReader(str(path)).stream():
        if chunk.entity_path == "/smoothed/state/temperature" and not chunk.is_static:
            batch = chunk.to_record_batch()
            values = batch["Scalars:scalars"].flatten().to_numpy().reshape(-1, 3)
            rows += list(zip(batch["time"].cast("int64").to_pylist(), values, strict=True))
    return np.array([values for _, values in sorted(rows, key=lambda row: row[0])])


def test_what_is_smoothed_is_drawn_in_recording_and_report(tmp_path, nisus):
    name = drive(tmp_path)
    table_file, out, html = (tmp_path / f"run.{end}" for end in ("csv", "rrd", "html"))
    nisus("fold", name, "--out", table_file, "--smooth")
    nisus("fold", name, "--out", out, "--html", html, "--smooth")
    table = np.genfromtxt(table_file, delimiter=",", names=True, dtype=None, encoding=None)
    mean, std = table["temperature_smooth"], table["temperature_smooth_std"]
    # Rows of one time are drawn once, as the last of them.
    last = np.flatnonzero(np.diff(table["t_ns"].astype(float), append=np.inf))
    np.testing.assert_allclose(
        smoothed_lines(out), np.stack((mean, mean + 2 * std, mean - 2 * std), axis=1)[last], rtol=1e-12
    )
    # A recording is never replaced.
    before = out.read_bytes()
    assert f"--out {out}: is there already" in nisus.refuses("fold", name, "--out", out)
    assert out.read_bytes() == before
    # The charts of the report have it too, with a sentence; without --smooth there is none.
    text = html.read_text()
    assert "smoothed states, which also use later measurements" in text
    data, columns = data_of(text)
    assert set(data["streams"]) == {"live", "smoothed"}
    seconds, shown = columns("smoothed")
    states = ("temperature", "rate")
    assert set(shown) == {f"{kind}:{state}" for kind in ("mean", "upper", "lower") for state in states}
    np.testing.assert_allclose(seconds, (table["t_ns"] - table["t_ns"][0]) * 1e-9, atol=1e-9)
    for state in states:
        mean, std = table[f"{state}_smooth"], table[f"{state}_smooth_std"]
        for kind, drawn in (("mean", mean), ("upper", mean + 2 * std), ("lower", mean - 2 * std)):
            np.testing.assert_allclose(shown[f"{kind}:{state}"], drawn, rtol=1e-6, atol=1e-6)
    nisus("fold", name, "--html", html)
    text = html.read_text()
    assert set(data_of(text)[0]["streams"]) == {"live"} and "smoothed states" not in text


def test_a_part_of_the_log_is_scored_by_the_filter_that_ran_from_the_start(tmp_path, nisus):
    """Scores, counts, episodes, report and their times are of the part; the oracle is the table of all rows."""
    rng = np.random.default_rng(4)
    t = np.arange(400.0)
    read = 40.0 + 0.02 * t + 3.0 * rng.standard_normal(t.size)
    read[250:] += 9.0 * rng.standard_normal(150)  # noise that is three times as large as said
    truth = 40.0 + 0.02 * t
    lines = [f"{a},{b},{c},0.02" for a, b, c in zip(t, read, truth, strict=True)]
    twin = drive(tmp_path, "\n".join(["t,y,temperature,rate", *lines]), DRIVE + "sensors: {winding: {std: 3}}\n")
    out = tmp_path / "track.parquet"
    nisus("fold", twin, "--out", out)
    table = pq.read_table(out).to_pandas()
    for since, until, begin, end in (("200", "250", 200, 250), (None, "50%", 0, 199.5), ("62.5%", None, 249.4, 400)):
        options = [text for name, text in (("--since", since), ("--until", until)) if text for text in (name, text)]
        told = nisus("fold", twin, *options, "--json").json
        part = table[(table.seconds >= begin) & (table.seconds < end)]
        used = part[part.verdict == "used"]
        assert told["readings"] == told["used"] == told["nis"]["n"] == len(used)
        assert (told["start"], told["end"]) == (part.seconds.min(), part.seconds.max())
        assert told["nis"]["mean"] == pytest.approx(used.nis.mean(), rel=1e-12)
        assert told["log_likelihood"] == pytest.approx(used.log_likelihood.sum(), rel=1e-9)
        known = part[part.event == "truth"]
        error = known.temperature - known.temperature_true
        assert told["rmse"]["temperature"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)
        assert told["calibration"][0]["n"] == len(used) and told["nees"]["n"] == len(known)
        assert told["nis"]["place"] == ("above" if begin > 200 else "inside")
        assert any(item["cause"] == "narrow" for item in told["episodes"]) == (begin > 200)
    shown = nisus("fold", twin, "--since", "200", "--until", "250").out
    assert "scored" not in nisus("fold", twin).out and re.search(r"scored +200 s to 249 s", shown)
    (row,) = nisus("compare", twin, "--estimators", "kf", "--since", "200", "--until", "250", "--json").json
    told = nisus("fold", twin, "--since", "200", "--until", "250", "--json").json
    assert [row["nis"], *row["nis_bounds"]] == pytest.approx([told["nis"][key] for key in ("mean", "low", "high")])


@cases(__file__, "wrong_parts.csv")
def test_a_part_without_measurements_is_one_line(option, text, tmp_path, nisus):
    assert text in nisus.refuses("fold", drive(tmp_path), *option.split())
