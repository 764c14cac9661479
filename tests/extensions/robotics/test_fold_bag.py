"""Twins fed by a bag of ROS 2, and estimates written as one: the same numbers as from and in a table."""

import sys
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from app.study.log_overview import overview
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from sources.worker_process import read_isolated
from tests.support import folded

from .bags import joints, odometry, write_folder, write_mcap

START = 1_700_000_000 * 10**9

TWIN = """\
model: motor_winding
source:
  type: table
  files: {files}
  time: {{column: {time}, unit: {unit}}}
  sensors: {{winding: {{columns: "{y}", accuracy: {{variance: "{variance}"}}}}}}
  truth: {{temperature: {{columns: "{truth}"}}}}
"""


def twins(folder, n=200):
    """Twins of an MCAP, of a folder of SQLite, and of a CSV of the same numbers."""
    rng = np.random.default_rng(4)
    y, truth, variance = 40 + rng.normal(size=n), 40 + rng.normal(size=n), rng.uniform(0.1, 4, n)
    t = START + np.cumsum(rng.integers(10**7, 10**9, n))
    messages, rows = [], ["t,y,variance,truth"]
    for k in range(n):
        at = int(t[k])
        messages += [("/odom", at + 10**6, odometry(at, y[k], 0.0, variance[k]))]
        messages += [("/reference", at + 2 * 10**6, joints(at, ["winding"], [truth[k]]))]
        rows.append(f"{at},{y[k]!r},{variance[k]!r},{truth[k]!r}")
    write_mcap(folder / "drive.mcap", messages)
    write_folder(folder / "drive", messages, "sqlite3")
    (folder / "drive.csv").write_text("\n".join(rows).replace("np.float64(", "").replace(")", "") + "\n")
    of_bag = {
        "time": "time", "unit": "s", "y": "/odom.pose.pose.position.x", "variance": "/odom.pose.covariance.x",
        "truth": "/reference.position[winding]",
    }  # fmt: skip
    of_csv = {"time": "t", "unit": "ns", "y": "y", "variance": "variance", "truth": "truth"}
    found = []
    for name, files, names in (
        ("mcap", "drive.mcap", of_bag),
        ("folder", "drive", of_bag),
        ("csv", "drive.csv", of_csv),
    ):
        found.append(folder / f"{name}.yaml")
        found[-1].write_text(TWIN.format(files=files, **names))
    return found[0], found[1], found[2]


def test_a_bag_folds_to_the_bits_of_a_table(tmp_path, nisus):
    mcap, folder, csv = twins(tmp_path)
    tables = []
    for k, twin in enumerate((mcap, folder, csv)):
        nisus("fold", twin, "--out", tmp_path / f"{k}.parquet", "--json")
        tables.append(pq.read_table(tmp_path / f"{k}.parquet"))
    assert tables[0].num_rows == 400 and len(set(tables[0]["temperature"].to_pylist())) > 100
    assert same_bits(tables[0], tables[2]) and same_bits(tables[1], tables[2])
    # Another recording in place of its own: the folder, which --log names too.
    nisus("fold", mcap, "--log", tmp_path / "drive", "--out", tmp_path / "3.parquet", "--json")
    assert same_bits(pq.read_table(tmp_path / "3.parquet"), tables[2])


def test_a_bag_dropped_on_the_page_is_read_in_another_process(tmp_path):
    """Which itself starts the process that reads the file."""
    mcap, _, _ = twins(tmp_path, 50)
    found = read_isolated(overview, mcap.with_name("drive.mcap"), None, [], None)[0]
    figures = {one.name: (one.number, one.missing) for one in found.signals}
    assert figures["/odom.pose.pose.position.x"] == figures["/reference.position[winding]"] == (50, 0)


def same_bits(a, b):
    """Whether all columns are equal, NaN to NaN, but the number of the tuning, which counts those of the process."""
    assert a.column_names == b.column_names
    for name in set(a.column_names) - {"tuning_version"}:
        left, right = a[name], b[name]
        if str(left.type) == "double":
            np.testing.assert_array_equal(left.to_numpy(), right.to_numpy(), err_msg=name)
        else:
            assert left.to_pylist() == right.to_pylist(), name
    return True


def test_an_estimate_is_written_as_a_bag(tmp_path, nisus):
    """The reader of rosbags, which did not write the container, is the oracle, and a fold with all covariances."""
    twin, *_ = twins(tmp_path)
    out = tmp_path / "estimate.mcap"
    nisus("fold", twin, "--out", out, "--smooth", "--json")
    nisus("fold", twin, "--out", tmp_path / "track.parquet", "--smooth", "--json")
    table = pq.read_table(tmp_path / "track.parquet")
    store = get_typestore(Stores.ROS2_HUMBLE)
    found: dict[str, list[Any]] = {}
    with Reader(out) as bag:
        for connection, t, data in bag.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((t, message))
    assert set(found) == {"/mcap/estimate", "/mcap/smoothed", "/mcap/covariance"}
    names = ["temperature", "rate"]
    for topic, ending in (("/mcap/estimate", ""), ("/mcap/smoothed", "_smooth")):
        times, messages = zip(*found[topic])
        stamps = [one.header.stamp.sec * 10**9 + one.header.stamp.nanosec for one in messages]
        assert list(times) == stamps == table["t_ns"].to_pylist()
        assert all(one.name == names and one.velocity.size == 0 for one in messages)
        for k, name in enumerate(names):
            np.testing.assert_array_equal([one.position[k] for one in messages], table[f"{name}{ending}"])
            spread = f"{name}_smooth_std" if ending else f"{name}_std"
            np.testing.assert_array_equal([one.effort[k] for one in messages], table[spread])
    loaded = load_twin(twin)
    log, _ = read_log(loaded, None)
    fold = folded(loaded.estimator, loaded.model, log, loaded.tuning, pairs=np.array([[0, 1]]))
    matrices = np.array([one.data.reshape(2, 2) for _, one in found["/mcap/covariance"]])
    np.testing.assert_array_equal(matrices[:, 0, 1], fold.track.cross[:, 0])
    np.testing.assert_array_equal(matrices[:, 1, 0], fold.track.cross[:, 0])
    np.testing.assert_array_equal(np.diagonal(matrices, axis1=1, axis2=2), fold.track.std**2)
    assert found["/mcap/covariance"][0][1].layout.dim[1].label == "temperature,rate"
    # One estimate is the measurement of another twin, with its variance.
    second = tmp_path / "second.yaml"
    second.write_text(
        "model: motor_winding\nsource:\n  type: table\n  files: estimate.mcap\n  time: {column: time}\n  sensors:\n"
        '    winding: {columns: "/mcap/estimate.position[temperature]",'
        ' accuracy: {std: "/mcap/estimate.effort[temperature]"}}\n'
    )
    read, _ = read_log(load_twin(second), None)
    np.testing.assert_array_equal(read.events.value[:, 0], table["temperature"])
    np.testing.assert_array_equal(read.events.value[:, loaded.model.width], table["temperature_std"].to_numpy() ** 2)


def test_packages_are_missed_before_anything_is_folded(tmp_path, nisus, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    said = nisus.refuses("fold", "motor_winding", "--out", tmp_path / "e.mcap")
    assert said == f"nisus: --out {tmp_path}/e.mcap: a ROS 2 bag needs mcap and rosbags: pip install 'nisus[robotics]'"
    assert not (tmp_path / "e.mcap").exists()
    said = nisus.refuses("fold", "lorenz63", "--out", "track.txt")
    assert said == "nisus: --out track.txt: must end in .csv, .parquet, .mcap or .rrd"
