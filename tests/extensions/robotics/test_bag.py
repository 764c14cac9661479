"""Bags of ROS 2: written with the libraries' writers and read back, and whatever is wrong with them is one line."""

import sqlite3
import sys

import numpy as np
import pytest
from mcap.writer import CompressionType
from scipy.spatial.transform import Rotation

from app.extensions.robotics.bag import bag_names
from estimators.errors import SourceError
from estimators.log import INPUT, READING
from sources.formats import files_of, is_recording
from sources.inspect import inspect_recordings
from sources.source import Accuracy, Channel, Condition
from sources.tables.rows import names_of
from sources.tables.table import Table, TimeColumn
from sources.units import heading_unit
from tests.sources.can.can_tools import Reports, same
from tests.support import read_all

from .bags import STORE, fix, imu, joints, msg, odometry, write_folder, write_mcap

S = 10**9
START = 1_700_000_000 * S + 123_456_789
RECORDED = 7_000_000  # ns between the stamp of a message and its recording

WAYS = {
    "folder.mcap": lambda path, messages: files_of(write_folder(path / "drive", messages)),
    "folder.db3": lambda path, messages: files_of(write_folder(path / "drive", messages, "sqlite3")),
    "packed.db3": lambda path, messages: files_of(write_folder(path / "drive", messages, "sqlite3", packed=True)),
    "file.mcap": lambda path, messages: [write_mcap(path / "drive.mcap", messages)],
    "raw.mcap": lambda path, messages: [write_mcap(path / "raw.mcap", messages, compression=CompressionType.NONE)],
}


def table(files, channels, report=lambda key, text: None, width=2, time="time"):
    return Table(files, time=TimeColumn(time), channels=channels, width=width, report=report)


def reading(index, *columns, **more):
    return Channel(READING, index, f"sensor {index}", columns, **more)


def recorded(*items):
    """Messages with the times of their recording, which differ from their stamps."""
    return [(topic, t + RECORDED, message) for topic, t, message in items]


@pytest.mark.parametrize("way", WAYS)
def test_values_stamps_and_variances_are_read_exactly(tmp_path, way):
    rng = np.random.default_rng(1)
    x, speed, elbow, variance = rng.normal(size=(4, 300))
    variance = variance**2
    t = START + np.cumsum(rng.integers(1, S, 300))
    messages = []
    for k in range(300):
        at = int(t[k])
        names = ["wrist", "elbow"] if k % 2 else ["elbow", "wrist"]
        pair = [k, elbow[k]] if k % 2 else [elbow[k], k]
        messages += recorded(
            ("/odom", at, odometry(at, x[k], speed[k], variance[k])),
            ("/arm/joint_states", at + 1, joints(at + 1, names, pair)),
            ("/cmd", at + 2, msg("std_msgs/Float64", data=float(k))),
        )
    files = WAYS[way](tmp_path, messages)
    channels = [
        reading(0, "/odom.pose.pose.position.x", accuracy=Accuracy(("/odom.pose.covariance.x",), squared=True)),
        reading(1, "/odom.twist.twist.linear.x"),
        reading(2, "/arm/joint_states.position[elbow]"),
        Channel(INPUT, 0, "command", ("/cmd.data",)),
    ]
    events = read_all(table(files, channels, width=1))
    for index, at, values in ((0, t, x), (1, t, speed), (2, t + 1, elbow)):
        mine = events.of_sensor(index)
        np.testing.assert_array_equal(events.t[mine], at)
        np.testing.assert_array_equal(events.value[mine, 0], values)
        np.testing.assert_array_equal(events.value[mine, 1], variance if index == 0 else np.full(300, np.nan))
    commands = events.kind == INPUT
    np.testing.assert_array_equal(events.t[commands], t + 2 + RECORDED)  # without a header, the time of recording
    np.testing.assert_array_equal(events.value[commands, 0], np.arange(300.0))
    assert len(events) == 1200 and all(is_recording(file.name) for file in files)


def test_a_stamp_of_zero_is_none(tmp_path):
    path = write_mcap(
        tmp_path / "a.mcap", [("/j", START, joints(0, ["a"], [1.0])), ("/j", START + 5, joints(9, ["a"], [2]))]
    )
    assert read_all(table([path], [reading(0, "/j.position[a]")])).t.tolist() == [START, 9]


def test_a_message_without_the_joint_is_no_measurement_of_it(tmp_path):
    """Two drivers share a topic; each message has the joints of one."""
    messages = [("/j", START + k, joints(START + k, ["ab"[k % 2]], [float(k)])) for k in range(10)]
    events = read_all(table([write_mcap(tmp_path / "a.mcap", messages)], [reading(0, "/j.position[b]")]))
    assert events.value[:, 0].tolist() == [1, 3, 5, 7, 9] and events.t.tolist() == [START + k for k in (1, 3, 5, 7, 9)]


def test_invalid_fixes_and_unknown_quantities_are_missing(tmp_path):
    turned = tuple(Rotation.from_euler("xyz", [0.1, -0.2, 2.5]).as_quat())
    messages = recorded(
        ("/fix", START, fix(START, 48.0, 11.0, (4.0, 9.0, 16.0))),
        ("/fix", START + S, fix(START + S, 48.0, 11.0, (4.0, 9.0, 16.0), status=-1)),
        ("/fix", START + 2 * S, fix(START + 2 * S, 48.0, 11.0, (4.0, 9.0, 16.0), known=0)),
        ("/imu", START, imu(START, 0.3, None)),
        ("/imu", START + S, imu(START + S, 0.4, turned)),
    )
    axes = ("roll", "pitch", "yaw")
    channels = [
        reading(
            0, "/fix.latitude", "/fix.longitude", convert="east_north", model_units=("m", "m"),
            accuracy=Accuracy(("/fix.position_covariance.x", "/fix.position_covariance.y"), squared=True),
        ),
        reading(1, "/imu.angular_velocity.z"),
        *(reading(2 + k, f"/imu.orientation.{axis}") for k, axis in enumerate(axes)),
        reading(5, "/imu.angular_velocity_covariance.z"),
    ]  # fmt: skip
    events = read_all(table([write_mcap(tmp_path / "a.mcap", messages)], channels))
    nan = np.nan
    found = {k: events.value[events.channel == k] for k in range(6)}
    np.testing.assert_array_equal(found[0], [[0, 0, 4, 9], [nan, nan, nan, nan], [nan, nan, nan, nan]])
    np.testing.assert_array_equal(found[1][:, 0], [0.3, 0.4])
    # scipy is the oracle of the angles; both round to a few units in the last place.
    for k, angle in enumerate((0.1, -0.2, 2.5)):
        np.testing.assert_allclose(found[2 + k][:, 0], [nan, angle], rtol=1e-14)
    np.testing.assert_array_equal(found[5][:, 0], [3.0, 3.0])


def test_conditions_hold_within_a_message(tmp_path):
    items = [("/fix", START + k, fix(START + k, 48.0, 11.0 + k, (1.0, 1.0, 1.0), status=k)) for k in range(3)]
    channel = reading(0, "/fix.longitude", where=(Condition("/fix.status.status", 1, 2),))
    events = read_all(table([write_mcap(tmp_path / "a.mcap", items)], [channel]))
    np.testing.assert_array_equal(events.value[:, 0], [np.nan, 12.0, 13.0])


def test_columns_of_other_messages(tmp_path):
    array = msg("std_msgs/Float64MultiArray", msg("std_msgs/MultiArrayLayout", [], 0), np.array([5.0, 6.0]))
    scan = msg("std_msgs/Float64MultiArray", msg("std_msgs/MultiArrayLayout", [], 0), np.zeros(65))
    messages = [
        ("/a", START, array),
        ("/b", START, msg("std_msgs/Bool", True)),
        ("/scan", START, scan),
        ("/text", START, msg("std_msgs/String", "on")),
        ("/twist", START, msg("geometry_msgs/TwistStamped", header_of(), twist())),
    ]
    path = write_mcap(tmp_path / "a.mcap", messages)
    parts = [f"/twist.twist.{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"]
    assert bag_names(path) == ["time", "/a.data[0]", "/a.data[1]", "/b.data", *parts]
    found = {one.name: one for one in inspect_recordings([path]).columns}
    assert (found["/a.data[1]"].values.tolist(), found["/b.data"].values.tolist()) == ([6.0], [1.0])
    assert found["/twist.twist.angular.z"].t.tolist() == [3 * S]
    # The name of a joint is no unit, though it reads like one.
    assert heading_unit("/joint_states.position[m]") is None and heading_unit("Level [m]") == "m"


def header_of():
    from .bags import header

    return header(3 * S)


def twist():
    from .bags import xyz

    return msg("geometry_msgs/Twist", xyz(1.0, 2.0, 3.0), xyz(4.0, 5.0, 6.0))


def test_a_bag_of_several_files_is_read_in_their_order(tmp_path):
    folder = write_folder(tmp_path / "drive", [("/j", START, joints(START, ["a"], [0.0]))], "sqlite3")
    for k in (10, 2):  # drive_10 comes before drive_2 by name
        other = write_folder(tmp_path / f"{k}", [("/j", START + k, joints(START + k, ["a"], [float(k)]))], "sqlite3")
        (other / f"{k}.db3").rename(folder / f"drive_{k}.db3")
    text = (folder / "metadata.yaml").read_text()
    assert "- drive.db3" in text
    (folder / "metadata.yaml").write_text(
        text.replace("- drive.db3", "- drive.db3\n  - drive_2.db3\n  - drive_10.db3", 1)
    )
    files = files_of(folder)
    assert [file.name for file in files] == ["drive.db3", "drive_2.db3", "drive_10.db3"]
    assert read_all(table(files, [reading(0, "/j.position[a]")])).value[:, 0].tolist() == [0, 2, 10]
    (folder / "metadata.yaml").write_text(text.replace("drive.db3", "drive.db3.zstd"))
    with pytest.raises(SourceError, match=r"drive\.db3\.zstd: is no \.mcap or \.db3; if it is compressed, unpack it"):
        files_of(folder)
    (folder / "metadata.yaml").write_text("a: 1")
    with pytest.raises(SourceError, match=r"metadata\.yaml: does not list the files of the bag; name its"):
        files_of(folder)


def test_a_database_without_definitions_has_those_of_ros(tmp_path):
    """Before Iron, rosbag2 did not store them."""
    path = tmp_path / "old.db3"
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        base.execute("INSERT INTO topics VALUES(1, '/odom', 'nav_msgs/msg/Odometry', 'cdr')")
        data = bytes(STORE.serialize_cdr(odometry(START, 1.5, 2.5, 1.0), "nav_msgs/msg/Odometry"))
        base.execute("INSERT INTO messages VALUES(1, 1, ?, ?)", (START + 9, data))
    base.close()
    events = read_all(table([path], [reading(0, "/odom.twist.twist.linear.x")]))
    assert (events.t.tolist(), events.value[0, 0]) == ([START], 2.5)


def series(n=400):
    return [("/j", START + k * S, joints(START + k * S, ["a"], [float(k)])) for k in range(n)]


@pytest.mark.parametrize("name", ["a.mcap", "a.db3"])
def test_a_bag_that_is_cut_gives_its_beginning_and_one_notice(tmp_path, name):
    """As a recorder leaves it that was killed."""
    if name == "a.mcap":
        whole = write_mcap(tmp_path / name, series())
    else:
        whole = write_folder(tmp_path / "a", series(), "sqlite3") / name
    events = read_all(table([whole], [reading(0, "/j.position[a]")]))
    content = whole.read_bytes()
    assert len(events) == 400
    bad, some = tmp_path / f"bad_{name}", 0
    for length in np.linspace(1, len(content) - 1, 12).astype(int):
        bad.write_bytes(content[:length])
        reports = Reports()
        try:
            found = read_all(table([bad], [reading(0, "/j.position[a]")], reports))
        except SourceError as error:
            assert str(bad) in str(error) and "\n" not in str(error)
            continue
        some += 0 < len(found) < 400
        assert same(found, events.select(slice(0, len(found))))
        assert reports.counts["truncated file"] == (len(found) < 400 or name == "a.mcap")
    assert some >= (8 if name == "a.mcap" else 0)
    if name == "a.mcap":
        bad.write_bytes(content[: len(content) // 2])
        contents = inspect_recordings([bad])
        assert contents.faults == [f"{bad}: it is cut short; check that it is complete"]
        assert reports.texts["truncated file"].startswith("bad_a.mcap: damaged after ")


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_flipped_bytes_are_reported(tmp_path, compression):
    content = write_mcap(tmp_path / "a.mcap", series(), compression=compression).read_bytes()
    bad, rng = tmp_path / "bad.mcap", np.random.default_rng(5)
    for _ in range(12):
        damaged = bytearray(content)
        for at in rng.integers(0, len(content), 4):
            damaged[at] ^= 1 << int(rng.integers(8))
        bad.write_bytes(damaged)
        reports = Reports()
        try:
            found = read_all(table([bad], [reading(0, "/j.position[a]")], reports))
        except SourceError as error:
            assert str(bad) in str(error)
            continue
        # Chunks have a checksum, so what is there is right; what is not there is reported.
        assert np.all(np.isin(found.value[:, 0], np.arange(400.0)))
        assert len(found) == 400 or reports.counts


def test_a_message_that_cannot_be_decoded_is_left_out(tmp_path, monkeypatch):
    plain = STORE.serialize_cdr

    def short(message, kind):
        data = bytes(plain(message, kind))
        return data[:20] if message.position[0] == 7.0 else data

    monkeypatch.setattr(STORE, "serialize_cdr", short)
    path = write_mcap(tmp_path / "a.mcap", series(20))
    reports = Reports()
    found = read_all(table([path], [reading(0, "/j.position[a]")], reports))
    assert found.value[:, 0].tolist() == [k for k in range(20) if k != 7]
    assert reports.counts == {"unreadable value": 1}
    assert reports.texts["unreadable value"].startswith("a.mcap:8: a message of /j cannot be decoded (")


def test_what_a_bag_lacks_is_one_line(tmp_path, monkeypatch):
    path = write_mcap(tmp_path / "a.mcap", series(5))
    with pytest.raises(SourceError, match=r"there is no column '/j\.position\[b\]'; did you mean /j\.position\[a\]"):
        table([path], [reading(0, "/j.position[b]")])
    with pytest.raises(SourceError, match=r"times of a bag are in its column 'time', not '/j\.position\[a\]'"):
        read_all(table([path], [reading(0, "/j.position[a]")], time="/j.position[a]"))
    json = write_mcap(tmp_path / "json.mcap", series(5), encoding="json")
    with pytest.raises(
        SourceError, match=r"has no columns; /j: its messages are encoded as json, and only CDR is read"
    ):
        names_of(json)
    empty = write_mcap(tmp_path / "empty.mcap", [])
    with pytest.raises(SourceError, match=r"empty\.mcap: has no columns; it holds no messages"):
        names_of(empty)
    text = tmp_path / "text.mcap"
    text.write_text("t,x\n1,2\n")
    with pytest.raises(SourceError, match=r"text\.mcap: it cannot be read as MCAP \(not a valid MCAP file"):
        names_of(text)
    text.rename(tmp_path / "text.db3")
    with pytest.raises(SourceError, match=r"text\.db3: it cannot be read as a ROS 2 bag \(.*\); check that it is comp"):
        names_of(tmp_path / "text.db3")
    (tmp_path / "a.mcap").rename(tmp_path / "a.csv")
    with pytest.raises(SourceError, match=r"a\.csv: is no table; it is an MCAP file; let its name end in \.mcap"):
        names_of(tmp_path / "a.csv")
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(SourceError, match=r"needs mcap and rosbags: pip install 'nisus\[robotics\]'"):
        bag_names(json)
