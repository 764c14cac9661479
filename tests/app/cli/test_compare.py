"""`nisus compare` and `nisus filters`: the table of a twin, and which filters fit it."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pyarrow import csv as pa_csv

import app.cli.compare
import app.study.compare
from app.study.compare import fold_row, tidy, within
from app.study.scores import SCORES, FilterScore, Spread, cells, printed, read_scores, scores_file, write_scores
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from config.loader import load, shipped
from estimators.errors import ConfigError
from estimators.fold import Fold, fold
from estimators.registry import ESTIMATORS
from estimators.track import GATED, USED
from tests.app.cli.test_compare_tables import ScoreCell, read_cell, read_span, refold
from tests.support import as_log

NOTHING = Spread(np.nan)
ROWS = [
    FilterScore(
        "kf", {"°C": Spread(1.04321), "V": Spread(0.01)}, Spread(0.823), (0.7, 1.3), Spread(0.892), 1.26e-6, {}
    ),
    FilterScore(
        "pf",
        {"°C": Spread(1.04321, 0.0123), "V": Spread(123.4, 56.7)},
        Spread(0.8231, 1e-9),
        (0.7, 1.3),
        Spread(0.8919, 0.0213),
        1.26e-4,
        {"particles": 4000},
        seeds=8,
        span=20.0,
        diverged=2,
        since=12.5,
        lost=0.25,
    ),
    FilterScore("ukf", {}, NOTHING, (np.nan, np.nan), NOTHING, np.nan, {}, failure="no factor"),
]
LINES = cells(ROWS, events=241, seconds=120.0)


def test_scores_are_read_back_as_they_were_written(tmp_path):
    twin = tmp_path / "pump.yaml"
    assert read_scores(twin) == []
    write_scores(twin, LINES[:1])
    assert write_scores(twin, LINES) == tmp_path / "pump.scores.csv"
    assert read_scores(twin) == LINES
    # Every row has every column, so that any reader of CSV finds a rectangle.
    assert len({tuple(line) for line in LINES}) == 1


def test_scores_of_a_twin_that_ships_have_a_folder_of_their_own(monkeypatch):
    monkeypatch.chdir(SCORES.parent)
    assert scores_file(Path("twins/motor_can.yaml")) == scores_file(load_twin("motor_can").path)
    assert sorted(path.name for path in SCORES.iterdir()) == [f"{name}.csv" for name in shipped()]


def test_scores_that_cannot_be_written_say_where(tmp_path):
    (tmp_path / "pump.scores.csv").mkdir()
    with pytest.raises(ConfigError, match=r"pump\.scores\.csv: cannot be written: Is a directory"):
        write_scores(tmp_path / "pump.yaml", LINES)


@pytest.mark.parametrize("name", shipped())
def test_pandas_and_pyarrow_read_the_scores_without_being_told_how(name):
    """Each figure is a number to both, and what is empty is missing."""
    lines = read_scores(load(name).path)
    frame, table = pd.read_csv(SCORES / f"{name}.csv"), pa_csv.read_csv(SCORES / f"{name}.csv")
    assert list(frame.columns) == table.column_names == list(lines[0])
    for title in lines[0]:
        if title in ("filter", "options", "failure"):
            continue
        expected = [float(line[title]) if line[title] else np.nan for line in lines]
        np.testing.assert_array_equal(frame[title].to_numpy(float), expected)
        given = [np.nan if value is None else value for value in table[title].to_pylist()]
        np.testing.assert_array_equal(given, expected)
    assert frame["filter"].tolist() == table["filter"].to_pylist() == [line["filter"] for line in lines]


def test_figures_are_printed_to_the_digits_that_mean_something():
    kf, pf, ukf = LINES
    assert kf == {
        "filter": "kf", "RMSE [°C]": "1.043", "RMSE spread [°C]": "", "RMSE [V]": "0.01000", "RMSE spread [V]": "",
        "mean NIS": "0.8230", "mean NIS spread": "", "NIS low": "0.700", "NIS high": "1.300", "NIS dof": "1",
        "in band [%]": "89.2", "in band spread [%]": "", "cost [µs/step]": "1.26", "seeds": "1", "diverged": "0",
        "diverged at [s]": "", "diverged [% of events]": "", "span [s]": "", "options": "", "failure": "",
        "events": "241", "log [s]": "120",
    }  # fmt: skip
    assert pf | {"events": "", "log [s]": ""} == {
        "filter": "pf", "RMSE [°C]": "1.043", "RMSE spread [°C]": "0.012", "RMSE [V]": "123", "RMSE spread [V]": "57",
        "mean NIS": "0.8231", "mean NIS spread": "0.0001", "NIS low": "0.700", "NIS high": "1.300", "NIS dof": "1",
        "in band [%]": "89.2", "in band spread [%]": "2.1", "cost [µs/step]": "126", "seeds": "8", "diverged": "2",
        "diverged at [s]": "12.5", "diverged [% of events]": "25", "span [s]": "20", "options": "particles=4000",
        "failure": "", "events": "", "log [s]": "",
    }  # fmt: skip
    assert ukf["mean NIS"] == ukf["RMSE [V]"] == ukf["NIS low"] == "" and ukf["failure"] == "no factor"
    assert read_span(pf) == 20.0 and read_span(kf) is None
    assert read_cell(pf, "RMSE [V]") == ScoreCell(123.0, 57.0, 0.5)
    assert read_cell(kf, "mean NIS")[::2] == (0.823, 0.00005)
    assert np.isnan(read_cell(ukf, "mean NIS").value)


def test_the_printed_table_says_what_the_cells_say():
    caption, *table = printed("pump", LINES)
    assert caption == "pump: 241 events in 120 s; ± one of 8 seeds"
    assert [re.split(r"\s{2,}", line) for line in table] == [
        ["filter", "RMSE [°C]", "RMSE [V]", "NIS / dof", "if consistent", "in band [%]", "µs/step", "notes"],
        ["kf", "1.043", "0.01000", "0.8230", "0.700 to 1.300", "89.2", "1.26"],
        ["pf", "1.043±0.012", "123±57", "0.8231±0.0001", "0.700 to 1.300", "89.2±2.1", "126",
         "diverged in 2 of 8 at 12.5 s, 25 % of events, first 20 s, particles 4000"],
        ["ukf", "-", "-", "-", "-", "-", "-", "no factor"],
    ]  # fmt: skip
    assert printed("pump", LINES, logs=20)[0].endswith("± one of 20 logs")
    # Of measurements with four rows: 1 is right for every twin.
    wide = cells([replace(ROWS[0], nis=Spread(3.292), nis_bounds=(2.8, 5.2), nis_dof=4.0)], 241, 120.0)
    _, _, line = printed("pump", wide)
    assert re.split(r"\s{2,}", line)[3:5] == ["0.8230", "0.700 to 1.300"]
    head, first, second, _ = table
    assert head.index("NIS / dof") == second.index("0.8231") and head.index("µs/step") == first.index("1.26")


def test_what_the_gate_refuses_is_told_where_it_refuses_anything():
    """Every figure of a row leaves the refused readings out."""
    rows = [replace(ROWS[0], refused=0.2372), replace(ROWS[1], refused=0.0), ROWS[2]]
    lines = cells(rows, events=241, seconds=120.0)
    assert [line["refused [%]"] for line in lines] == ["24", "0", ""]
    _, _, kf, pf, ukf = printed("pump", lines)
    assert kf.endswith("rejected 24 % of the readings") and "rejected" not in pf + ukf
    assert "refused [%]" not in LINES[0]


def test_bounds_of_a_baseline_come_with_the_nis_that_they_judge():
    """A baseline counts rejected measurements: a NIS of 0.98 inside bounds of 1.09 to 2.47 would read as below them."""
    row = FilterScore("ekf", {}, Spread(1.07), (1.2, 2.7), Spread(np.nan), 1e-6, {}, nis_dof=1.1, nis_judged=1.804)
    lines = cells([row, replace(row, estimator="ukf", nis_judged=1.071)], 10, 1.0)
    assert [line["NIS judged"] for line in lines] == ["1.804", ""]
    _, _, first, second = printed("car", lines)
    assert first.split()[:5] == ["ekf", "0.9727", "1.091", "to", "2.455"]
    assert first.endswith("NIS 1.64 with rejected readings, as its bounds") and "rejected" not in second
    assert "NIS judged" not in cells([replace(row, nis_judged=1.07)], 10, 1.0)[0]


def test_the_share_refused_is_that_of_a_fold():
    twin = load_twin("motor_winding", overrides={"gate": "0.8"})
    events = read_log(twin, 60)[0].events
    verdicts = fold("kf", twin.model, twin.tuning, as_log(events)).verdict
    refused = np.mean(verdicts[(verdicts == USED) | (verdicts == GATED)] == GATED)
    assert fold_row(twin, "kf", [events]).refused == refused > 0.05


def test_twins_describes_one_with_its_scores(tmp_path, nisus):
    assert [line.split()[0] for line in nisus("twins").out.splitlines()] == shipped()
    shown = nisus("twins", "lorenz63").out
    assert shown.startswith("lorenz63: Lorenz 63, the butterfly\n\nThe butterfly: three states that change wings")
    assert shown.endswith("\n".join(["", "", *printed("lorenz63", read_scores(load("lorenz63").path)), ""]))
    path = tmp_path / "pump.yaml"
    path.write_text("# A pump.\n#\n# Second.\nmodel: lorenz63\nsource: {type: simulator}\n# Not the head.\n")
    told = "No scores yet; to write them: nisus compare pump --write"
    assert nisus("twins", path).out == f"pump\n\nA pump.\n\nSecond.\n\n{told}\n"
    assert "no twin of that name ships" in nisus.refuses("twins", "lorenz")


def test_compare_says_what_fold_says(nisus):
    arguments = ["motor_winding", "--duration", "60"]
    found = nisus("compare", *arguments, "--json", "--estimators", "kf", "ukf").json
    rows = {row["estimator"]: row for row in found}
    assert list(rows) == ["kf", "ukf"]
    for name, row in rows.items():
        alone = nisus("fold", *arguments, "--estimator", name, "--json").json
        assert row["nis"] == alone["nis"]["mean"]
        assert row["rmse"]["°C"] == pytest.approx(alone["rmse"]["temperature"], rel=1e-12)
        assert 0.0 < row["seconds_per_step"] and 0.5 < row["coverage"] <= 1.0
        assert row["seeds"] == 1 and row["spread"]["nis"] is None


def test_a_filter_that_draws_folds_with_several_seeds():
    twin = load_twin("motor_winding")
    events = read_log(twin, 30)[0].events
    row = fold_row(twin, "etkf", [events])
    alone = [refold(twin, "etkf", events, seed)["mean NIS"] for seed in range(8)]
    assert row.seeds == len(set(alone)) == 8
    assert row.nis == pytest.approx((np.mean(alone), np.std(alone, ddof=1)), rel=1e-12)


def test_logs_of_other_seeds_are_those_of_the_simulator(nisus):
    given = ["compare", "motor_winding", "--duration", "60", "--json", "--estimators", "kf"]
    (both,) = nisus(*given, "--logs", "2").json
    alone = []
    for seed in (7, 8):
        alone += nisus(*given, "--set", f"source.seed={seed}").json
    assert both["rmse"]["°C"] == pytest.approx(np.mean([row["rmse"]["°C"] for row in alone]), rel=1e-12)
    assert both["nis"] == pytest.approx(np.mean([row["nis"] for row in alone]), rel=1e-12) and both["seeds"] == 2


def test_a_slow_filter_folds_a_stated_span(monkeypatch):
    """A step takes 0.1 ms by a clock of the test's own: a budget of 60 ms is 600 of the log's 12,953 events."""
    twin = load_twin("motor_can")
    events = read_log(twin, None)[0].events
    stepped = 0
    advance = Fold.advance

    def counted(fold: Fold, limit: int | None = None) -> int:
        nonlocal stepped
        count = advance(fold, limit)
        stepped += count
        return count

    monkeypatch.setattr(Fold, "advance", counted)
    monkeypatch.setattr(app.study.compare.time, "process_time", lambda: 1e-4 * stepped)
    row = fold_row(twin, "filterpy-ekf", [events], budget=0.06)
    assert row.span == tidy((events.t[599] - events.t[0]) * 1e-9)
    assert row.seconds_per_step == pytest.approx(1e-4)
    first = within(events, row.span)
    assert first.t[-1] <= events.t[0] + row.span * 1e9 < events.t[len(first)]
    assert row.nis.value == refold(twin, "filterpy-ekf", first)["mean NIS"]


@pytest.mark.parametrize("budget", [1e-9, 1e-3, 2e-3, 4e-3])
def test_a_span_ends_between_two_times(budget):
    """Wherever the budget ends among events of one time: the log has five at each step, of which three are readings."""
    twin = load_twin("motor_joint", overrides={"source.duration": "60"})
    events = read_log(twin, None)[0].events
    row = fold_row(twin, "filterpy-ekf", [events], budget=budget)
    assert row.span is not None and row.span >= 0.5
    assert row.nis.value == refold(twin, "filterpy-ekf", within(events, row.span))["mean NIS"]


@pytest.mark.parametrize(("seconds", "lower"), [(0.6, 0.5), (1.0, 1.0), (4.99, 2.0), (70.0, 50.0), (1999.0, 1000.0)])
def test_spans_are_round(seconds, lower):
    assert tidy(seconds) == pytest.approx(lower, rel=1e-12)


def test_divergence_is_noted_with_its_time():
    """Told a prior that is 40 times too narrow, the winding's filter is far from the readings from the first on."""
    twin = load_twin("motor_winding", overrides={"prior.temperature.std": "0.001", "Q.temperature": "0", "Q.rate": "0",
                                                 "prior.rate.std": "0.0001", "R.winding": "0.01"})  # fmt: skip
    events = read_log(twin, None)[0].events
    row = fold_row(twin, "kf", [events])
    # Health judges from the tenth reading on, which comes after 10 s.
    assert row.diverged == 1 and row.since == pytest.approx(10.0) and row.lost > 0.9


def test_all_twins_in_turn_and_those_without_a_recording_are_named(monkeypatch, tmp_path, nisus):
    good = tmp_path / "pump.yaml"
    text = "model: motor_winding\nestimator: kf\nsource: {type: simulator, seed: 1, step: 1, duration: 10}\n"
    good.write_text(text, encoding="utf-8")
    bad = tmp_path / "lost.yaml"
    source = "source: {type: table, files: no.csv, time: {column: t}, sensors: {winding: {columns: w}}}\n"
    bad.write_text(f"model: motor_winding\nestimator: kf\n{source}", encoding="utf-8")
    monkeypatch.setattr(app.cli.compare, "shipped", lambda: [str(bad), str(good)])
    monkeypatch.setattr(app.study.compare, "ESTIMATORS", {"kf": ESTIMATORS["kf"]})
    assert "no.csv" in nisus.refuses("compare", "all", "--write")
    (line,) = read_scores(good)
    assert line["filter"] == "kf" and line["events"] == "21"
    assert good.read_text(encoding="utf-8") == text
    assert not scores_file(bad).exists()


def test_filters_lists_all_and_says_why_not(nisus):
    listed = nisus("filters").out
    assert all(re.search(rf"^{re.escape(name)} \(", listed, re.M) for name in ESTIMATORS)
    assert nisus("filters", "ukf").out.strip() in listed and "\nekf (" not in nisus("filters", "ukf").out
    assert "did you mean kf" in nisus.refuses("filters", "kff")
    fitting = nisus("filters", "--twin", "motor_can").out
    assert nisus("filters", "motor_can").out == fitting
    assert "no: motor_drive is not linear" in fitting
    # Nine sigma points thirty times a second; twenty numbers of eight bytes.
    assert re.search(r"ukf .*20 × 8 B = 160 B .*9 × 30 = 27\d", fitting)
    # 200 members in its YAML; the auxiliary filter propagates its 2000 particles twice.
    assert re.search(r"letkf .* 200 × 30 = 6,00\d", fitting) and re.search(
        r"apf .* 4,000 × 30 = 120,\d{3} .* yes", fitting
    )
    assert "applies" in fitting and not re.search(r"\de\+", fitting)


def test_options_of_other_filters_are_checked_where_they_stand(tmp_path, nisus):
    path = tmp_path / "pump.yaml"
    text = "model: motor_winding\nestimator: kf\nsource: {type: simulator, seed: 1, step: 1, duration: 10}\n"
    path.write_text(text + "filters:\n  ukf: {alpha: 0}\n", encoding="utf-8")
    line = nisus.refuses("fold", str(path))
    assert "pump.yaml:5" in line and "alpha is 0" in line
