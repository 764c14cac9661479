"""`nisus log` tells what was written into a file, and `nisus new --log` writes a twin of it that runs."""

import can
import numpy as np
import pytest
import yaml

from app.study.advice.signals import noise_of
from app.twin.twin import load_twin
from sources.inspect import SignalSeries
from tests.cases import cases

DBC = """VERSION ""

NS_ :

BS_:

BU_: ECU

BO_ 256 ENGINE: 8 ECU
 SG_ Temp : 0|16@1+ (0.1,-40) [0|0] "degC" ECU
 SG_ Rpm : 16|16@1+ (0.25,0) [0|0] "rpm" ECU
 SG_ Always m0 : 32|8@1+ (1,0) [0|0] "" ECU
 SG_ Never m1 : 32|8@1+ (1,0) [0|0] "" ECU
 SG_ Which M : 40|8@1+ (1,0) [0|0] "" ECU
"""
START = 1_700_000_000


@pytest.fixture
def drive(tmp_path):
    """Ten a second for 60 s, with a hole of 5 s; another id twice a second on bus 1."""
    rng = np.random.default_rng(5)
    (tmp_path / "car.dbc").write_text(DBC)
    seconds = np.arange(600) * 0.1 + np.where(np.arange(600) < 300, 0, 5)
    temp, rpm = 90 + np.cumsum(rng.normal(0, 0.3, 600)), 2000 + 500 * np.sin(0.2 * seconds)
    with can.Logger(tmp_path / "drive.blf") as log:
        for k in range(600):
            t = START + float(seconds[k])
            words = [round((temp[k] + 40) / 0.1), round(rpm[k] / 0.25)]
            data = b"".join(word.to_bytes(2, "little") for word in words) + bytes(4)
            log(can.Message(timestamp=t, arbitration_id=256, is_extended_id=False, data=data, channel=0))
            if k % 5 == 0:
                log(can.Message(timestamp=t, arbitration_id=0x18FEF100, data=bytes(2), channel=1))
    return tmp_path


def test_what_was_written_is_listed(drive, nisus):
    found = nisus("log", str(drive / "drive.blf"), "--dbc", str(drive / "car.dbc"), "--json").json
    assert found["number"] == 720 and found["faults"] == []
    assert found["start_ns"] // 10**6 == START * 1000 and round((found["end_ns"] - found["start_ns"]) / 1e8) == 649
    [hole] = found["holes_ns"]
    assert (hole[1] - hole[0]) / 1e9 == pytest.approx(5.1, abs=0.001)
    assert [(m["bus"], m["id"], m["extended"], m["name"], m["number"]) for m in found["messages"]] == [
        (0, 256, False, "ENGINE", 600),
        (1, 0x18FEF100, True, None, 120),
    ]
    assert [m["rate"] for m in found["messages"]] == pytest.approx([10, 2], rel=1e-3)
    signals = {item["name"]: item for item in found["messages"][0]["signals"]}
    assert {name: item["number"] for name, item in signals.items()} == {
        "Temp": 600, "Rpm": 600, "Always": 600, "Never": 0, "Which": 600,
    }  # fmt: skip
    assert signals["Rpm"]["high"] == pytest.approx(2500, abs=1) and signals["Rpm"]["unit"] == "rpm"
    text = nisus("log", str(drive / "drive.blf")).out
    assert "720 frames in 64.9 s, from 2023-11-14 22:13:20 UTC" in text and "1 gaps: 5.1 s at 29.9 s" in text
    assert "0x18fef100x" in text


def test_a_bus_that_a_database_is_not_for_stays_without_names(drive, nisus):
    found = nisus("log", drive / "drive.blf", "--dbc", f"{drive / 'car.dbc'}@1", "--json").json
    assert [message["name"] for message in found["messages"]] == [None, None]


def test_where_is_proposed_for_columns_of_quality(tmp_path, nisus):
    """192 is good by OPC Data Access 3.00, section 6.8; a state that may be OK is no quality."""
    rows = "0,1,Good,192,OK\n1,2,Bad,0,Run\n2,3,Uncertain,64,OK\n"
    (tmp_path / "a.csv").write_text(f"t,x,Status,Quality,State\n{rows}")
    text = " ".join(nisus("log", str(tmp_path / "a.csv")).out.split())
    for condition in ('{"Status": ["Good"]}', '{"Quality": [192, null]}'):
        assert f"(rows: 2); to leave these rows out give valid_if: {condition}" in text
    assert text.count(" valid_if: ") == 2


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".npz", ".mat"])
def test_a_table_is_listed(tmp_path, nisus, ending):
    path = tmp_path / f"a{ending}"
    columns = {"time": np.arange(50) * 0.5, "x": np.arange(50.0), "y": np.full(50, np.nan)}
    if ending == ".csv":
        rows = zip(*columns.values(), strict=True)
        path.write_text("time,x,y\n" + "".join(f"{t},{x},\n" for t, x, _ in rows))
    elif ending == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table(columns), path)
    elif ending == ".npz":
        np.savez(path, **columns)
    else:
        from scipy.io import savemat

        savemat(path, columns)
    found = nisus("log", str(path), "--json").json
    assert found["kind"] == "table" and found["time"] == "time" and found["number"] == 50
    x, y = found["columns"]
    assert (x["name"], x["number"], x["rate"], x["low"], x["high"]) == ("x", 50, 2.0, 0.0, 49.0)
    assert (y["name"], y["number"], y["missing"]) == ("y", 0, 50)
    assert f"--time 'when': is no column of {path}; choose from time, x, y" in nisus.refuses(
        "log", str(path), "--time", "when"
    )


def test_units_of_a_table_are_listed(tmp_path, nisus):
    (tmp_path / "a.csv").write_text(
        "t,level_m,Flow [l/min],x\n" + "".join(f"{k},{k % 3},{k % 5},{k % 7}\n" for k in range(30))
    )
    rows = [line.split()[:4] for line in nisus("log", tmp_path / "a.csv").out.splitlines()[-4:]]
    assert rows == [
        ["column", "unit", "number", "rate"],
        ["level_m", "m", "30", "1"],
        ["Flow", "[l/min]", "l/min", "30"],
        ["x", "30", "1", "0.0"],
    ]


def test_a_twin_of_a_recording_folds_as_it_stands(drive, nisus):
    given = ["--log", str(drive / "drive.blf"), "--dbc", str(drive / "car.dbc"), "--signals", "Rpm,ENGINE.Temp"]
    path = drive / "pump.yaml"
    yaml, python, *checked = nisus("new", "pump", "--folder", drive, *given).out.splitlines()
    assert (yaml, python) == (str(path), str(drive / "pump.py"))
    assert checked[2].startswith("consistent: mean NIS 1.09 per degree of freedom")
    assert checked[-1] == f"Next: nisus run {path}"
    twin = load_twin(path)
    assert set(twin.model.sensor_names) == {"rpm", "temp"}
    # The engine speed is a sine: its rate has a noise that lasts for some of its 31 s.
    offsets = ("temp_offset_deviation", "rpm_offset_deviation")  # of one step of their values
    assert twin.model.state_names == ("temp", "rpm", "rpm_rate", "rpm_rate_disturbance", *offsets)
    score = nisus("fold", str(path), "--json").json
    assert score["readings"] == 1200 and score["failed"] == 0
    # The temperature is a random walk, 0.3² a step.
    assert 0.5 < score["nis"]["mean"] < 1.5
    assert "readings 1200" in nisus("run", str(path), "--headless", "--speed", "inf").out


def test_what_cannot_be_taken_is_said(drive, nisus):
    new = ["new", "pump", "--folder", str(drive), "--log", str(drive / "drive.blf")]
    assert "--signals Tmp: is not in the log; did you mean Temp?" in nisus.refuses(
        *new, "--dbc", str(drive / "car.dbc"), "--signals", "Tmp"
    )
    assert "Never: has 0 values" in nisus.refuses(*new, "--dbc", str(drive / "car.dbc"), "--signals", "Never")
    assert "give one that describes it with --dbc" in nisus.refuses(*new)
    assert not list(drive.glob("pump*"))


def series(values, dt=0.1):
    t = (np.arange(values.size) * dt * 1e9).astype(np.int64)
    return SignalSeries("x", "", t, values)


def test_the_noise_of_a_signal_is_found_in_its_differences():
    """Of walks that were made with a noise that is known; 20,000 values tell a variance to some percent."""
    rng, n, dt = np.random.default_rng(1), 20_000, 0.1
    walk = np.cumsum(rng.normal(0, np.sqrt(4.0 * dt), n)) + rng.normal(0, 0.5, n)
    smooth, q, r = noise_of(series(walk))
    assert not smooth and q == pytest.approx(4.0, rel=0.15) and r == pytest.approx(0.25, rel=0.1)
    # A speed that is a random walk: the exact covariance of a step, so that ⅔ dt³ is right.
    half = np.linalg.cholesky(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * 9.0)
    x, out = np.zeros(2), np.empty(n)
    for k in range(n):
        x = np.array([x[0] + dt * x[1], x[1]]) + half @ rng.normal(size=2)
        out[k] = x[0]
    smooth, q, r = noise_of(series(out + rng.normal(0, 0.01, n)))
    assert smooth and q == pytest.approx(9.0, rel=0.15) and r == pytest.approx(1e-4, rel=0.3)


def test_tables_of_other_columns_are_listed_one_after_the_other(tmp_path, nisus):
    (tmp_path / "one.csv").write_text("time,a\n0,1\n1,2\n")
    (tmp_path / "two.csv").write_text("seconds,b\n2,1\n3,2\n")
    said = nisus("log", str(tmp_path / "one.csv"), str(tmp_path / "two.csv"))
    assert "one.csv: 2 rows in 1.0 s" in said.out and "two.csv: 2 rows in 1.0 s" in said.out
    parts = nisus("log", str(tmp_path / "one.csv"), str(tmp_path / "two.csv"), "--json").json["parts"]
    assert [[column["name"] for column in part["columns"]] for part in parts] == [["a"], ["b"]]
    # Their times do not overlap, which is said with the remedy.
    assert "two.csv begins 1 s after the end of one.csv; " in said.err and "time.shift" in said.err


@cases(__file__, "undrafted.csv")
def test_a_file_of_which_no_twin_can_be_drafted_is_refused_with_the_remedy(
    drive, nisus, monkeypatch, content, more, said
):
    path = drive / "a.csv"
    path.write_text(content)
    monkeypatch.chdir(drive)
    given = [word.format(path) for word in more.split()]
    assert said.format(path) in nisus.refuses("new", "pump", "--log", str(path), *given)
    assert not list(drive.glob("pump*"))


def test_a_draft_keeps_the_dialect_that_was_given_and_fits_its_log(tmp_path, nisus):
    """A random walk of 0.1 a second, with noise of 0.05, in a dialect that is not detected."""
    rng = np.random.default_rng(0)
    walk = 20 + np.cumsum(rng.normal(0, 0.1, 600)) + rng.normal(0, 0.05, 600)
    rows = "".join(f"{k}^{x:.3f}\n" for k, x in enumerate(walk))
    (tmp_path / "a.csv").write_text("Plant 7\nRate^1\nno^TT102\ntime^TT101\n" + rows)
    assert "give --delimiter, or --skip" in nisus.refuses("log", str(tmp_path / "a.csv"))
    given = ["--log", str(tmp_path / "a.csv"), "--delimiter", "^", "--heading", "4"]
    nisus("new", "plant", "--folder", str(tmp_path), *given)
    source = yaml.safe_load((tmp_path / "plant.yaml").read_text())["source"]
    assert (source["delimiter"], source["heading"], source["sensors"]) == ("^", 4, {"tt101": {"columns": "TT101"}})
    assert nisus("fold", str(tmp_path / "plant.yaml"), "--json").json["twin"] == "plant"


@pytest.mark.parametrize("command", ["log", "advise"])
@pytest.mark.parametrize("name", ["folder", "folder.csv"])
def test_a_folder_without_recordings_is_refused(tmp_path, nisus, command, name):
    (tmp_path / name).mkdir()
    said = nisus.refuses(command, str(tmp_path / name))
    assert f"{name}: holds no recording; name a file that ends in .csv" in said


def test_a_draft_tells_which_column_and_unit_of_time_it_assumes(tmp_path, nisus):
    rng, start = np.random.default_rng(2), 1_710_489_600_000
    rows = [f"{500 - k},{start + 1000 * k},{x:.3f}\n" for k, x in enumerate(np.cumsum(rng.normal(0, 1, 300)))]
    (tmp_path / "a.csv").write_text("left,stamp_1,x\n" + "".join(rows))
    said = nisus("new", "made", "--folder", tmp_path, "--log", str(tmp_path / "a.csv")).err
    assert f"a.csv:2: stamp_1 is {start}, taken as ms since 1970 (2024-03-15 08:00 UTC); set the time's unit" in said
    assert 'time: {column: "stamp_1", unit: ms}' in (tmp_path / "made.yaml").read_text()
    folded = nisus("fold", str(tmp_path / "made.yaml"))
    assert "taken as" not in folded.err


@pytest.mark.parametrize(
    ("heading", "step", "unit"),
    [
        ("Time,T [°C]", "10", "s"),
        ("time,T", "10", "s"),
        ("T [degC],Time [s]", "10", "s"),
        ("Zeit/min,T [°C]", "0.5", "min"),
        ("Time (days),T [°C]", "0.25", "d"),
        ("Elapsed (hours),T [°C]", "0.25", "h"),
        ("time_ms,T", "10", "ms"),
    ],
)
def test_the_time_and_its_unit_are_those_of_the_heading(tmp_path, nisus, heading, step, unit):
    """A temperature T is no time, and a unit of time may follow a slash or stand in brackets."""
    rows = [(f"{k * float(step):g}", str(20 + k % 7)) for k in range(40)]
    rows = [row[::-1] if heading.startswith("T [") else row for row in rows]
    (tmp_path / "a.csv").write_text("\n".join([heading, *map(",".join, rows)]) + "\n", encoding="utf-8")
    found = nisus("log", str(tmp_path / "a.csv"), "--json").json
    seconds = {"s": 1, "ms": 1e-3, "min": 60, "h": 3600, "d": 86_400}[unit]
    assert found["end_ns"] - found["start_ns"] == round(39 * float(step) * seconds * 1e9)
    assert [one["name"][0] for one in found["columns"]] == ["T"]


def test_a_format_that_fits_no_row_is_refused_also_after_a_remark(tmp_path, nisus):
    (tmp_path / "a.csv").write_text("Plant 7\ntime,x\n" + "".join(f"03/05/26 08:00:{k:02} AM,{k}\n" for k in range(50)))
    said = nisus.refuses("log", str(tmp_path / "a.csv"))
    assert said.endswith('(time.format, --time-format): "%d/%m/%y %I:%M:%S %p" or "%m/%d/%y %I:%M:%S %p"')
    assert "heading in line 2; no row has a time; a.csv:3: time is '03/05/26 08:00:00 AM'" in nisus.refuses(
        "log", str(tmp_path / "a.csv"), "--time-format", "%m/%d/%y %H:%M:%S"
    )
    read = nisus("log", str(tmp_path / "a.csv"), "--time-format", "%m/%d/%y %I:%M:%S %p", "--json").json
    assert read["start_ns"] == 1_772_697_600 * 10**9  # date -u -d 2026-03-05T08:00 +%s


@pytest.mark.parametrize(("zone", "written"), [("UTC+1", "+01:00"), ("+01:00", "+01:00"), ("Etc/GMT-1", "Etc/GMT-1")])
def test_a_time_zone_may_be_an_offset_which_the_twin_keeps(tmp_path, nisus, zone, written):
    rng = np.random.default_rng(2)
    rows = [f"2024-03-15 09:{k // 60:02}:{k % 60:02},{x:.3f}\n" for k, x in enumerate(np.cumsum(rng.normal(0, 1, 300)))]
    (tmp_path / "a.csv").write_text("time,x\n" + "".join(rows))
    options = "--log", str(tmp_path / "a.csv"), "--time-zone", zone
    assert "no time zone" not in nisus("new", "made", "--folder", tmp_path, *options).err
    assert f'zone: "{written}"}}' in (tmp_path / "made.yaml").read_text()
    assert (
        nisus("log", *options[1:], "--json").json["start_ns"] == 1_710_489_600 * 10**9
    )  # date -u -d 2024-03-15T08 +%s
    loaded = load_twin(tmp_path / "made.yaml")
    assert loaded.config.source.time.zone == written
    (tmp_path / "made.yaml").write_text((tmp_path / "made.yaml").read_text().replace(written, "+25:00"))
    assert "is no time zone of this machine" in nisus.refuses("fold", str(tmp_path / "made.yaml"))
    assert "--time-zone +25:00: is no time zone" in nisus.refuses("log", options[1], "--time-zone", "+25:00")


def test_a_unit_in_each_cell_is_said_with_the_next_step(tmp_path, nisus):
    rows = "".join(f"{k},{1 + k / 8} kW,{'AB'[k % 2]}\n" for k in range(40))
    (tmp_path / "a.csv").write_text("t,power,mode\n" + rows)
    line = "power has a unit in each cell, such as '1.0 kW': write the numbers alone, and power [kW] in the heading"
    assert nisus("log", str(tmp_path / "a.csv"), "--json").json["faults"] == [line]
    said = nisus.refuses("new", "made", "--folder", tmp_path, "--log", str(tmp_path / "a.csv"))
    assert said == f"nisus: {tmp_path / 'a.csv'}: no column beside t has numbers (text in power, mode); {line}"
