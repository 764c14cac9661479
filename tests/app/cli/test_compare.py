"""`nisus compare` and `nisus filters`: the table of a twin, and which filters fit it."""

import json
import re

import numpy as np
import pytest

import app.cli.compare
from app.cli.compare_fold import Figure, Row, fold_row, refold, tidy, within
from app.cli.compare_table import Cell, read_cell, read_span, read_table, table, write_table
from app.cli.fold import read_log
from app.cli.main import main
from app.twin.twin import load_twin
from estimators.registry import ESTIMATORS

NOTHING = Figure(np.nan)
ROWS = [
    Row("kf", {"°C": Figure(1.04321), "V": Figure(0.01)}, Figure(0.823), (0.7, 1.3), Figure(0.892), 1.26e-6, {}),
    Row(
        "pf",
        {"°C": Figure(1.04321, 0.0123), "V": Figure(123.4, 56.7)},
        Figure(0.8231, 1e-9),
        (0.7, 1.3),
        Figure(0.8919, 0.0213),
        1.26e-4,
        {"particles": 4000},
        seeds=8,
        span=20.0,
        diverged=2,
        since=12.5,
        lost=0.25,
    ),
    Row("ukf", {}, NOTHING, (np.nan, np.nan), NOTHING, np.nan, {}, failure="no factor"),
]
LINES = ["# nisus compare pump: 3 events", *table(ROWS)]


def test_a_written_table_stands_behind_the_text_and_is_replaced(tmp_path):
    path = tmp_path / "pump.yaml"
    path.write_text("# A pump.\nname: pump  # short\n", encoding="utf-8")
    write_table(path, [LINES[0], *table(ROWS[:1])])
    once = path.read_text(encoding="utf-8")
    assert once.startswith("# A pump.\n#\n# nisus compare pump: 3 events\n# filter")
    assert once.endswith("\n# end of nisus compare\nname: pump  # short\n")
    assert list(read_table(once)) == ["kf"]
    write_table(path, LINES)
    twice = path.read_text(encoding="utf-8")
    assert twice.count("end of nisus compare") == 1
    assert twice.startswith("# A pump.\n#\n# nisus compare") and twice.endswith("name: pump  # short\n")
    assert list(read_table(twice)) == ["kf", "pf", "ukf"]
    assert read_table("name: pump\n") == {}


def test_figures_are_printed_to_the_digits_that_mean_something():
    rows = read_table("\n".join([LINES[0], *(f"# {line}" for line in LINES[1:]), "# end of nisus compare"]))
    assert rows["kf"] == {
        "filter": "kf", "RMSE [°C]": "1.043", "RMSE [V]": "0.01000", "mean NIS": "0.8230", "in band [%]": "89.2",
        "µs/step": "1.26", "notes": "",
    }  # fmt: skip
    assert rows["pf"] == {
        "filter": "pf", "RMSE [°C]": "1.043±0.012", "RMSE [V]": "123±57", "mean NIS": "0.8231±0.0001",
        "in band [%]": "89.2±2.1", "µs/step": "126",
        "notes": "diverged in 2 of 8 at 12.5 s, 25 % of events, first 20 s, particles 4000",
    }  # fmt: skip
    assert rows["ukf"]["mean NIS"] == rows["ukf"]["RMSE [V]"] == "-" and rows["ukf"]["notes"] == "no factor"
    assert read_span(rows["pf"]) == 20.0 and read_span(rows["kf"]) is None
    assert read_cell("123±57") == Cell(123.0, 57.0, 0.5)
    assert read_cell("0.8230")[::2] == (0.823, 0.00005)
    assert np.isnan(read_cell("-").value)


def test_columns_stand_under_their_titles():
    head, first, second, third = table(ROWS)
    for title, cell in (("mean NIS", "0.8231"), ("µs/step", "126"), ("notes", "diverged")):
        assert head.index(title) == second.index(cell)
    assert head.index("µs/step") == first.index("1.26") and head.index("notes") == third.index("no factor")


def test_compare_says_what_fold_says(capsys):
    arguments = ["motor_winding", "--duration", "60"]
    assert main(["compare", *arguments, "--json", "--estimators", "kf", "ukf"]) == 0
    rows = {row["estimator"]: row for row in json.loads(capsys.readouterr().out)}
    assert list(rows) == ["kf", "ukf"]
    for name, row in rows.items():
        assert main(["fold", *arguments, "--estimator", name, "--json"]) == 0
        alone = json.loads(capsys.readouterr().out)
        assert row["nis"] == alone["nis"]["mean"]
        assert row["rmse"]["°C"] == pytest.approx(alone["rmse"]["temperature"], rel=1e-12)
        assert 0.0 < row["seconds_per_step"] and 0.5 < row["coverage"] <= 1.0
        assert row["seeds"] == 1 and row["spread"]["nis"] is None


def test_a_filter_that_draws_folds_with_several_seeds_and_several_logs():
    twin = load_twin("motor_winding")
    logs = [read_log(load_twin("motor_winding", overrides={"source.seed": seed}), 30)[0].readings for seed in "89"]
    row = fold_row(twin, "etkf", logs[:1])
    alone = [refold(twin, "etkf", logs[0], seed).nis for seed in range(8)]
    assert row.seeds == len(set(alone)) == 8
    assert row.nis == pytest.approx((np.mean(alone), np.std(alone, ddof=1)), rel=1e-12)
    row = fold_row(twin, "kf", logs)
    assert row.seeds == 2
    assert row.nis.value == pytest.approx(np.mean([refold(twin, "kf", log).nis for log in logs]), rel=1e-12)


def test_logs_of_other_seeds_are_those_of_the_simulator(capsys):
    given = ["compare", "motor_winding", "--duration", "60", "--json", "--estimators", "kf"]
    assert main([*given, "--logs", "2"]) == 0
    (both,) = json.loads(capsys.readouterr().out)
    alone = []
    for seed in (7, 8):
        assert main([*given, "--set", f"source.seed={seed}"]) == 0
        alone += json.loads(capsys.readouterr().out)
    assert both["rmse"]["°C"] == pytest.approx(np.mean([row["rmse"]["°C"] for row in alone]), rel=1e-12)
    assert main(["compare", "motor_can", "--logs", "2"]) == 2
    assert "is not simulated" in capsys.readouterr().err


def test_a_slow_filter_folds_a_stated_span():
    """A budget of 60 ms is 60 to 600 steps of FilterPy's, and the log of three minutes has 12,953."""
    twin = load_twin("motor_can")
    events = read_log(twin, None)[0].readings
    row = fold_row(twin, "filterpy-ekf", [events], budget=0.06)
    assert row.span is not None and 0.1 < row.span < 100
    first = within(events, row.span)
    assert first.t[-1] <= events.t[0] + row.span * 1e9 < events.t[len(first)]
    assert row.nis.value == refold(twin, "filterpy-ekf", first).nis


@pytest.mark.parametrize("budget", [1e-9, 1e-3, 2e-3, 4e-3])
def test_a_span_ends_between_two_times(budget):
    """Wherever the budget ends among events of one time: the log has five at each step, of which three are readings."""
    twin = load_twin("motor_joint", overrides={"source.duration": "60"})
    events = read_log(twin, None)[0].readings
    row = fold_row(twin, "filterpy-ekf", [events], budget=budget)
    assert row.span is not None and row.span >= 0.5
    assert row.nis.value == refold(twin, "filterpy-ekf", within(events, row.span)).nis


@pytest.mark.parametrize(("seconds", "lower"), [(0.6, 0.5), (1.0, 1.0), (4.99, 2.0), (70.0, 50.0), (1999.0, 1000.0)])
def test_spans_are_round(seconds, lower):
    assert tidy(seconds) == pytest.approx(lower, rel=1e-12)


def test_divergence_is_noted_with_its_time():
    """Told a prior that is 40 times too narrow, the winding's filter is far from the readings from the first on."""
    twin = load_twin("motor_winding", overrides={"prior.temperature.std": "0.001", "Q.temperature": "0", "Q.rate": "0",
                                                 "prior.rate.std": "0.0001", "R.winding": "0.01"})  # fmt: skip
    events = read_log(twin, None)[0].readings
    row = fold_row(twin, "kf", [events])
    # Health judges from the tenth reading on, which comes after 10 s.
    assert row.diverged == 1 and row.since == pytest.approx(10.0) and row.lost > 0.9


def test_all_twins_in_turn_and_those_without_a_recording_are_named(monkeypatch, tmp_path, capsys):
    good = tmp_path / "pump.yaml"
    text = "model: motor_winding\nestimator: kf\nsource: {type: simulator, seed: 1, step: 1, duration: 10}\n"
    good.write_text(text, encoding="utf-8")
    bad = tmp_path / "lost.yaml"
    source = "source: {type: table, files: no.csv, time: {column: t}, sensors: {winding: {columns: w}}}\n"
    bad.write_text(f"model: motor_winding\nestimator: kf\n{source}", encoding="utf-8")
    monkeypatch.setattr(app.cli.compare, "shipped", lambda: [str(bad), str(good)])
    monkeypatch.setattr(app.cli.compare, "ESTIMATORS", {"kf": ESTIMATORS["kf"]})
    assert main(["compare", "all", "--write"]) == 2
    assert "no.csv" in capsys.readouterr().err
    assert list(read_table(good.read_text(encoding="utf-8"))) == ["kf"]
    assert good.read_text(encoding="utf-8").endswith(text)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["motor_can", "--estimators", "kf"], "does not apply"),
        (["motor_winding", "--write", "--estimators", "kf"], "leave the other options out"),
        (["motor_winding", "--logs", "0"], "--logs 0"),
    ],
)
def test_compare_refuses(arguments, why, capsys):
    assert main(["compare", *arguments]) == 2
    assert why in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "near"),
    [("--durations", "--duration"), ("--seeds", None)],  # `nisus run` has --speed, which is nearer to --seeds
)
def test_an_unknown_option_is_told_near_ones_of_the_same_command(option, near, capsys):
    with pytest.raises(SystemExit):
        main(["compare", "lorenz63", option, "2"])
    said = capsys.readouterr().err
    assert f"Unrecognized options: {option}, 2" in said and "nisus compare --help" in said
    assert "--speed" not in said
    assert ("Perhaps you meant" in said) == (near is not None)
    assert near is None or f"    {near} " in said


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ("=3", "--set =3: has no key; write KEY=VALUE"),
        ("gate", "--set gate: has no value; write KEY=VALUE"),
        ("estimator=zzz", f"'zzz' does not exist; choose from {', '.join(ESTIMATORS)}\n"),
        ("zzz=1", "zzz is not a tuning key of lorenz63; choose from "),
        ("p.sgma=1", "did you mean p.sigma"),
    ],
)
def test_a_setting_that_is_none_is_told_what_it_might_be(given, why, capsys):
    assert main(["fold", "lorenz63", "--set", given]) == 2
    said = capsys.readouterr().err
    assert why in said and said.count("\n") == 1


def test_filters_lists_all_and_says_why_not(capsys):
    assert main(["filters"]) == 0
    listed = capsys.readouterr().out
    assert all(re.search(rf"│ {re.escape(name)} ", listed) for name in ESTIMATORS)
    assert main(["filters", "--twin", "motor_can"]) == 0
    fitting = capsys.readouterr().out
    assert "no: motor_drive is not linear" in fitting
    # Nine sigma points thirty times a second; twenty numbers of eight bytes.
    assert re.search(r"ukf .*20 × 8 B = 160 B .*9 × 30 = 27\d", fitting)
    # 200 members in its YAML; the auxiliary filter propagates its 2000 particles twice.
    assert re.search(r"letkf .* 200 × 30 = 6,00\d", fitting) and re.search(
        r"apf .* 4,000 × 30 = 120,\d{3} .* yes", fitting
    )
    assert "applies" in fitting and not re.search(r"\de\+", fitting)


def test_options_of_other_filters_are_checked_where_they_stand(tmp_path, capsys):
    path = tmp_path / "pump.yaml"
    text = "model: motor_winding\nestimator: kf\nsource: {type: simulator, seed: 1, step: 1, duration: 10}\n"
    path.write_text(text + "filters:\n  ukf: {alpha: 0}\n", encoding="utf-8")
    assert main(["fold", str(path)]) == 2
    line = capsys.readouterr().err
    assert "pump.yaml:5" in line and "alpha is 0" in line
