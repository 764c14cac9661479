"""`nisus migrate`: a twin and its tuning versions by the names of this version."""

from pathlib import Path

OLD = """model: battery_cell
time: {horizon: 0.5}           # s
source: {type: push}
"""


def test_migrate_rewrites_a_twin_and_its_versions_and_keeps_the_files(tmp_path, nisus, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("cell.yaml").write_text(OLD)
    Path("cell.tunings").mkdir()
    version = "version: {twin: cell, model: battery_cell, saved: now}\nvalid: {temperature: {min: 1, max: 2}}\n"
    Path("cell.tunings/a.yaml").write_text(version)
    twin, tuning = nisus("migrate", "cell.yaml", "--json").json
    assert (twin["kept"], tuning["kept"]) == ("cell.yaml.1.bak", "cell.tunings/a.yaml.1.bak")
    assert tuning["older"] == ["valid (line 2) is valid_range now", "an interval is [low, high] now"]
    assert Path("cell.yaml").read_text() == OLD.replace("horizon", "max_delay")
    assert Path("cell.yaml.1.bak").read_text() == OLD
    assert Path("cell.tunings/a.yaml").read_text().endswith("\nvalid_range: {temperature: [1, 2]}\n")
    again = nisus("migrate", "cell.yaml").out
    assert again == "cell.yaml: nothing to do\ncell.tunings/a.yaml: nothing to do\n"
    assert nisus("migrate", "motor_bench", "--json").json[0]["older"] == []
    # A file that is wrong is left, and the rest goes on.
    Path("bad.yaml").write_text("time: {horizon: 1, max_delay: 2}")
    Path("late.yaml").write_text(OLD)
    found = nisus.run("migrate", "bad.yaml", "none.yaml", "late.yaml")
    assert (
        found.status == 2
        and found.err.count("\n") == 2
        and "nisus: bad.yaml:1: time.horizon is max_delay now, which stands in line 1; keep one" in found.err
    )
    assert nisus.refuses("migrate").endswith("no file is named; give at least one")
    assert nisus.refuses("migrate", ".").endswith(".: it is a folder; give the YAML file in it")
    assert found.out.startswith("late.yaml: horizon (line 2) is max_delay now; the file as it was is late.yaml.1.bak")
