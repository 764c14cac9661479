"""`nisus fleet` on tables: every asset has the values of a fold over its own rows."""

import json
import socket

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from app.cli.main import main
from app.engine.store import Store
from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.running import RunningFleet
from app.twin.twin import load_twin
from estimators import Log
from estimators.errors import NisusError
from estimators.log import READING, Events
from estimators.track import HEALTH_NAMES, VERDICT_NAMES
from tests.cases import cases

pytestmark = pytest.mark.usefixtures("inside")

FLEET = """twin: motor_winding
source:
  type: table
  files: {files}
  time: {{column: time}}
  asset: pump
  sensors:
    winding: {{columns: temperature}}
"""


def pump_rows(seed=3, assets=5, count=40):
    """Time (s), asset and temperature of rows in the order of time; one asset is silent after half of them."""
    rng = np.random.default_rng(seed)
    names = [f"pump {k}" for k in range(assets)]
    rows = []
    for k in range(count):
        for name in names:
            y = 40.0 + 2.0 * float(rng.normal()) + 8.0 * (name == names[1]) * k / count
            if name != names[2] or k < count // 2:
                rows.append((2.0 * k + round(float(rng.random()), 3), name, round(y, 3)))
    return sorted(rows)


def write(path, rows):
    columns = [list(column) for column in zip(*rows, strict=True)]
    table = pa.table(dict(zip(("time", "pump", "temperature"), columns, strict=True)))
    (pyarrow.csv.write_csv if path.suffix == ".csv" else pyarrow.parquet.write_table)(table, path)


def run(folder, rows, more=""):
    """A fleet that has folded these rows, and what it said."""
    write(folder / "a.csv", rows)
    (folder / "pumps.yaml").write_text(FLEET.format(files="a.csv") + more)
    said = []
    running = RunningFleet(load_fleet("pumps.yaml"), lambda key, text: said.append(text), threads=1)
    running.run()
    running.stop()
    return running, said


def folded(rows, asset, until):
    """The last row of a fold over the rows of one asset, which is queried at the end if it was silent for long."""
    twin = load_twin("motor_winding")
    own = [(t, y) for t, name, y in rows if name == asset]
    t = np.array([round(t * 1e9) for t, _ in own])
    log = Log.of(twin.model)
    log.extend(Events.alike(READING, t, np.array([y for _, y in own])))
    if until - own[-1][0] > twin.policy.degraded_after:
        log.add_ticks(until)
    fold = twin.fold(log, policy=twin.policy, expected=np.zeros(1, np.bool_))
    fold.advance()
    return fold.track.select(fold.n - 1), fold.n


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_each_asset_has_the_values_of_a_fold_over_its_rows(ending, tmp_path, capsys):
    rows = pump_rows()
    write(tmp_path / f"a.{ending}", rows[:90])
    write(tmp_path / f"b.{ending}", rows[90:])
    (tmp_path / "pumps.yaml").write_text(FLEET.format(files=f"'?.{ending}'"))
    assert main(["fleet", "pumps.yaml", "--headless", "--json", "--out", f"table.{ending}"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["assets"] == 5 and sum(found["counts"].values()) == 5
    table = {row["asset"]: row for row in (dict(zip(found["columns"], row, strict=True)) for row in found["rows"])}
    for asset, row in table.items():
        last, events = folded(rows, asset, rows[-1][0])
        assert row["events"] == events and row["stale"] == 0
        assert (row["health"], row["verdict"]) == (HEALTH_NAMES[last.health], VERDICT_NAMES[last.verdict])
        got = [row[name] for name in ("temperature", "temperature_std", "rate", "rate_std", "nis_mean", "age")]
        assert got == [last.mean[0], last.std[0], last.mean[1], last.std[1], last.nis_mean, last.age]
    health = [HEALTH_NAMES.index(row["health"]) for row in table.values()]
    assert health == sorted(health, reverse=True) and table["pump 2"]["health"] == "stale"
    read = pyarrow.csv.read_csv if ending == "csv" else pyarrow.parquet.read_table
    written = read(f"table.{ending}").to_pydict()
    assert written["asset"] == list(table) and written["temperature"] == [row["temperature"] for row in table.values()]


def test_the_worst_assets_and_the_counts_are_printed(tmp_path, capsys):
    write(tmp_path / "a.csv", pump_rows())
    (tmp_path / "pumps.yaml").write_text(FLEET.format(files="a.csv"))
    assert main(["fleet", "pumps.yaml", "--headless", "--worst", "2"]) == 0
    text = capsys.readouterr().out
    assert "5 assets, 181 events." in text and "Worst 2 assets" in text
    worst = text.split("Worst 2 assets")[1].splitlines()[2:]
    assert len(worst) == 2 and worst[0].split()[:4] == ["pump", "2", "stale", "stale"]


@pytest.mark.parametrize(
    ("assets", "names", "refused"),
    [("2", ["pump 0", "pump 1"], "is beyond 2"), ("[pump 4, pump 9]", ["pump 4", "pump 9"], "is not among assets")],
)
def test_other_assets_are_refused_and_counted(assets, names, refused, tmp_path, capsys):
    rows = [(float(t), f"pump {k}", 40.0) for t in range(3) for k in range(5)]
    running, said = run(tmp_path, rows, f"assets: {assets}\n")
    _, found, table = running.table()
    assert found == names and table.events.sum() == 3 * len(set(names) & {name for _, name, _ in rows})
    assert f"pumps.yaml: asset 'pump 2' {refused}; add it to assets" in said
    assert running.counts["row of no asset"] == len(said)
    assert main(["fleet", "pumps.yaml", "--headless"]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "pumps.yaml" in line]
    assert told == [f"nisus: {said[0]}"]  # once, however many there are


def test_rows_of_a_blank_name_are_of_no_asset(tmp_path):
    running, said = run(tmp_path, [(0.0, "pump", 40.0), (1.0, "\u200b", 40.0), (2.0, "pump", 40.0)])
    assert running.names == ["pump"] and running.table()[2].events.sum() == 2
    assert said == ["pumps.yaml: asset '\\u200b' is blank; name it in the source"]


@cases(__file__, "wrong_fleets.csv")
def test_a_wrong_file_is_one_line(before, after, line, tmp_path, capsys):
    write(tmp_path / "a.csv", pump_rows(count=2))
    text = FLEET.format(files="a.csv")
    assert before in text
    (tmp_path / "pumps.yaml").write_text(text.replace(before, after))
    assert main(["fleet", "pumps.yaml", "--port", "0"]) == 2
    said = capsys.readouterr().err.strip()
    assert line in said and "\n" not in said and "pumps.yaml" in said


def test_a_live_source_without_measurements_is_told_from_wrong_channels(tmp_path, capsys):
    (tmp_path / "pumps.yaml").write_text("twin: motor_winding\nsource: {type: push}\n")
    assert main(["fleet", "pumps.yaml", "--headless", "--duration", "0.01"]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("compil")]
    assert told == ["nisus: pumps.yaml:2: no measurement arrived; check that its senders run"]


def test_open_alerts_of_a_fleet_are_kept_in_its_store(tmp_path, capsys):
    receivers = "outputs: {receivers: {ops: {type: webhook, url: 'http://127.0.0.1:9'}}}"
    (tmp_path / "pumps.yaml").write_text(f"twin: motor_winding\nsource: {{type: push}}\n{receivers}\n")
    assert main(["fleet", "pumps.yaml", "--headless", "--duration", "0.1", "--store", "."]) == 2
    assert Store(tmp_path / "pumps.store").read_blocks("alerts")
    capsys.readouterr()


def test_a_broker_that_is_not_there_is_told_once(tmp_path, capsys):
    pytest.importorskip("paho.mqtt")
    with socket.socket() as taken:  # bound and not listening: connections are refused
        taken.bind(("127.0.0.1", 0))
        place = f"127.0.0.1, port: {taken.getsockname()[1]}"
        topics = "{'plant/{asset}/t': winding}"
        (tmp_path / "pumps.yaml").write_text(
            f"{{twin: motor_winding, source: {{type: mqtt, host: {place}, topics: {topics}}}}}"
        )
        assert main(["fleet", "pumps.yaml", "--headless", "--duration", "0.5"]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if "no measurements from the broker at" in line]
    assert len(told) == 1 and told[0].endswith("it is tried again")


def test_a_tuning_that_fleets_cannot_have_names_the_twin(tmp_path):
    (tmp_path / "pumps.yaml").write_text(FLEET.format(files="a.csv"))
    plan = load_fleet("pumps.yaml", {"estimator": "pf"})
    with pytest.raises(NisusError, match=r"pumps.yaml:1: twin motor_winding: fleet: estimator pf .* Gaussian filter"):
        plan.fleet(1)
    (tmp_path / "pumps.yaml").write_text(f"{FLEET.format(files='a.csv')}late: 0\n")
    with pytest.raises(NisusError, match=r"pumps.yaml:9: late is 0, .*set gate.reopen to null"):
        load_fleet("pumps.yaml", {"gate": "0.99"})
    assert load_fleet("pumps.yaml").fleet(1).recent == 0


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_the_history_of_an_asset_is_a_table_of_its_rows(ending, tmp_path):
    rows = sorted([*pump_rows(), (1.0, "pump 30", 1.0)])
    write(tmp_path / f"a.{ending}", rows)
    (tmp_path / "pumps.yaml").write_text(FLEET.format(files=f"a.{ending}"))
    (folder := tmp_path / "copies").mkdir()
    twin = load_twin("motor_winding", overrides=load_fleet("pumps.yaml").history_of("pump 3", folder))
    assert (twin.name, twin.title) == ("pump_3", "pump 3")
    (copy,) = folder.iterdir()
    assert copy.stat().st_size < (tmp_path / f"a.{ending}").stat().st_size
    source = twin.open_source(lambda key, text: None)
    found = []
    while (batch := source.read(1.0)) is not None:
        found += batch.value[:, 0].tolist()
    source.close()
    assert found == [y for _, name, y in rows if name == "pump 3"]
