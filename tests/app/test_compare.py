"""`nisus compare` and `nisus filters`: the table of a twin, and which filters fit it."""

import json
import re

import pytest

from app.cli import main
from app.compare import Row, read_table, table, write_table
from estimators.registry import ESTIMATORS

ROWS = [
    Row("kf", {"°C": 1.04321, "V": 0.01}, 0.823, 0.7551, 1.278, 0.892, 1.26e-6),
    Row("ukf", {}, float("nan"), 0.0, 0.0, 0.0, 0.0, "diverged"),
]


def test_a_written_table_is_read_back_and_replaced(tmp_path):
    path = tmp_path / "pump.yaml"
    path.write_text("# A pump.\nname: pump\n", encoding="utf-8")
    write_table(path, ROWS[:1])
    once = path.read_text(encoding="utf-8")
    assert once.endswith("# A pump.\nname: pump\n")
    assert read_table(once) == {"kf": ["1.043", "0.01", "0.823", "0.755 - 1.278", "89.2 %", "1.26"]}
    write_table(path, ROWS)
    twice = path.read_text(encoding="utf-8")
    assert twice.count("end of nisus compare") == 1 and twice.endswith("# A pump.\nname: pump\n")
    assert read_table(twice)["ukf"] == ["diverged"]
    assert read_table("name: pump\n") == {}


def test_columns_stand_under_their_titles():
    head, first, second = table(ROWS)
    assert head.index("mean NIS") == first.index("0.823")
    assert second.split() == ["ukf", "diverged"]


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
        assert 0.0 < row["seconds_per_event"] and 0.5 < row["coverage"] <= 1.0


def test_compare_refuses_a_filter_that_does_not_apply(capsys):
    assert main(["compare", "motor_can", "--estimators", "kf"]) == 2
    assert "does not apply" in capsys.readouterr().err


def test_filters_lists_all_and_says_why_not(capsys):
    assert main(["filters"]) == 0
    listed = capsys.readouterr().out
    assert all(re.search(rf"│ {re.escape(name)} ", listed) for name in ESTIMATORS)
    assert main(["filters", "--twin", "motor_can"]) == 0
    fitting = capsys.readouterr().out
    assert "no: motor_drive is not linear" in fitting
    # Nine sigma points thirty times a second; twenty numbers of eight bytes.
    assert re.search(r"ukf .*20 × 8 B = 160 B .*9 × 30 = 27\d", fitting)


def test_options_of_other_filters_are_checked_where_they_stand(tmp_path, capsys):
    path = tmp_path / "pump.yaml"
    text = "model: motor_winding\nestimator: kf\nsource: {type: simulator, seed: 1, step: 1, duration: 10}\n"
    path.write_text(text + "filters:\n  ukf: {alpha: 0}\n", encoding="utf-8")
    assert main(["fold", str(path)]) == 2
    line = capsys.readouterr().err
    assert "pump.yaml:5" in line and "alpha is 0" in line
