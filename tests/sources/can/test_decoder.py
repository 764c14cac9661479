"""Decoding equals cantools' own, on random layouts and payloads; what does not decode is counted."""

import can
import cantools
import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import INPUT, READING, TRUTH
from sources.can.decoder import Decoder, ends_of
from sources.source import Accuracy, Channel, Condition
from tests.cases import cases
from tests.sources.can.can_tools import DBC, Reports, dbc, decoded, decoding, frame, sensor
from tests.support import error_of


def random_dbc(rng):
    """Messages of random signals: both byte orders, all lengths, signs, floats, scales; cantools wants no overlap."""
    lines, floats = ['VERSION ""', "NS_ :", "BS_:", "BU_: A"], []
    for k in range(60):
        size = int(rng.integers(1, 9)) if k < 50 else int(rng.choice([12, 24, 64]))
        lines.append(f"BO_ {k + 16} M{k}: {size} A")
        taken: set[int] = set()
        for j in range(int(rng.integers(1, 4))):
            for _ in range(100):
                kind = rng.choice(["int", "int", "float"]) if size >= 8 else "int"
                most = min(8 * size, 64 if j == 0 else 12)
                length = int(rng.choice([32, 64])) if kind == "float" else int(rng.integers(1, most + 1))
                start = int(rng.integers(0, 8 * size - length + 1))
                big = bool(rng.integers(2))
                # Bits counted from each byte's lowest; a big-endian signal counts from the highest.
                bits = {8 * (n // 8) + 7 - n % 8 if big else n for n in range(start, start + length)}
                if not bits & taken:
                    break
            else:
                continue
            taken |= bits
            position = 8 * (start // 8) + 7 - start % 8 if big else start
            sign = "-" if kind == "float" or rng.integers(2) else "+"
            scale, offset = [(1, 0), (0.01, -40), (2, 3), (0.0078125, 0), (-1.5, 1e-6)][rng.integers(5)]
            lines.append(f' SG_ S{j} : {position}|{length}@{0 if big else 1}{sign} ({scale},{offset}) [0|0] "" A')
            if kind == "float":
                floats.append(f"SIG_VALTYPE_ {k + 16} S{j} : {1 if length == 32 else 2};")
    return "\n".join(lines + floats) + "\n"


@pytest.mark.parametrize("seed", range(4))
def test_random_layouts_decode_as_cantools_does(tmp_path, seed):
    rng = np.random.default_rng(seed)
    path = dbc(tmp_path, random_dbc(rng))
    database = cantools.database.load_file(path, strict=False)
    names = [[signal.name for signal in database.get_message_by_name(f"M{k}").signals] for k in range(60)]
    channels = [sensor(k, f"M{k}", *names[k]) for k in range(60)]
    decoder = Decoder([(path, None)], channels, width=3)
    frames = []
    for k in rng.integers(0, 60, 1500):
        size = database.get_message_by_name(f"M{k}").length
        short = size if rng.random() < 0.8 else int(rng.integers(0, size + 1))
        frames.append((int(k), rng.bytes(short)))
    messages = [
        can.Message(timestamp=1.0, arbitration_id=k + 16, is_extended_id=False, is_fd=len(data) > 8, data=data)
        for k, data in frames
    ]
    batch = decoded(decoder, messages)
    assert batch.channel.tolist() == [k for k, _ in frames]
    for (k, data), row in zip(frames, batch.value, strict=True):
        expected = database.decode_message(k + 16, data, decode_choices=False, allow_truncated=True)
        theirs = np.array([float(expected.get(name, np.nan)) for name in names[k]])
        theirs[~np.isfinite(theirs)] = np.nan
        np.testing.assert_array_equal(row[: theirs.size], theirs, err_msg=f"M{k} {data.hex()}")


def test_extended_multiplexing_as_cantools_does(tmp_path):
    path, rng, reports = dbc(tmp_path), np.random.default_rng(1), Reports()
    database = cantools.database.load_file(path, strict=False)
    channels = [sensor(0, "MUX", "Speed"), sensor(1, "MUX", "Revs"), sensor(2, "MUX", "Code")]
    decoder = Decoder([(path, None)], channels, width=1, report=reports)
    expected, refused, cut, messages = [], 0, 0, []
    for _ in range(3000):
        size = int(rng.choice([8, 8, 8, 4, 3, 2, 1, 0]))
        data = bytes([rng.integers(0, 6), rng.choice([12, 13, 14, 28, 30, 31])]) + rng.bytes(6)
        data = data[:size]
        messages.append(frame(259, data))
        # cantools is silent where the frame ends before a multiplexer; here such a frame is counted.
        cut += size == 0 or (size == 1 and data[0] == 1)
        try:
            found = database.decode_message(259, data, decode_choices=False, allow_truncated=True)
        except (cantools.database.DecodeError, KeyError):
            refused += 1
            continue
        expected += [(k, found[name]) for k, name in enumerate(("Speed", "Revs", "Code")) if name in found]
    batch = decoded(decoder, messages)
    spoken = ~np.isnan(batch.value[:, 0])
    assert list(zip(batch.channel[spoken].tolist(), batch.value[spoken, 0].tolist(), strict=True)) == expected
    assert reports.counts["undecodable frame"] == refused + cut > cut > 0
    assert len({k for k, _ in expected}) == 3
    assert "MUX (0x103)" in reports.texts["undecodable frame"]


def test_a_signal_behind_the_frames_end_is_missing_and_counted(tmp_path):
    reports = Reports()
    decoder = decoding(tmp_path, [sensor(0, "ENGINE", "Temp", "Torque")], width=2, report=reports)
    batch = decoded(decoder, [frame(256, b"\xf4\x01\x00")])
    assert batch.value[0, 0] == 10.0 and np.isnan(batch.value[0, 1])
    assert reports.counts == {"short frame sensor0": 1}


def test_units_scale_offset_and_conditions(tmp_path):
    reports = Reports()
    channels = [
        sensor(0, "ENGINE", "Rpm", model_units=("rad/s",), scale=(-1.0,), offset=(5.0,)),
        sensor(1, "ENGINE", "Temp", model_units=("K",), where=(Condition("Ok", 1, 1),)),
    ]
    decoder = decoding(tmp_path, channels, report=reports)
    good = frame(256, bytes.fromhex("f401 0fa0 0000 0080".replace(" ", "")))
    bad = frame(256, bytes.fromhex("f401 0fa0 0000 0000".replace(" ", "")))
    batch = decoded(decoder, [good, bad])
    assert batch.channel.tolist() == [0, 1, 0, 1]
    assert batch.value[0, 0] == pytest.approx(-1000 * 2 * np.pi / 60 + 5, rel=1e-14)
    assert batch.value[1, 0] == pytest.approx(283.15, rel=1e-14)
    assert np.isnan(batch.value[3, 0]) and batch.value[2, 0] == batch.value[0, 0]
    assert reports.counts == {"condition sensor1": 1}
    assert reports.texts["condition sensor1"] == "sensor1: measurement rejected; it needs Ok in 1 to 1"


def test_inputs_of_a_frame_are_one_event_before_its_readings_and_truths(tmp_path):
    channels = [
        Channel(TRUTH, 2, "x", ("Torque",), "ENGINE"),
        Channel(READING, 1, "temp", ("Temp",), "ENGINE"),
        Channel(INPUT, 2, "rpm", ("Rpm",), "ENGINE"),
        Channel(INPUT, 0, "ok", ("Ok",), "ENGINE"),
    ]
    decoder = decoding(tmp_path, channels, width=3)
    batch = decoder.decode(decoder.gather([frame(256, bytes.fromhex("f4010fa001000080"), t=2.5)], [77]))
    assert batch.kind.tolist() == [INPUT, READING, TRUTH]
    assert batch.channel.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(batch.value[0], [1.0, np.nan, 1000.0])
    assert batch.value[1, 0] == 10.0 and batch.value[2, 0] == 0.5
    assert batch.t.tolist() == [2_500_000_000] * 3 and batch.arrival.tolist() == [77] * 3


def test_other_frames_are_rejected_before_decoding(tmp_path):
    decoder = decoding(tmp_path, [sensor(0, "ENGINE", "Temp"), sensor(1, "WIDE", "Ratio")])
    assert [f["can_id"] for f in decoder.filters] == [256, 512] and decoder.filters[1]["extended"]
    data = bytes(8)
    error = can.Message(arbitration_id=256, is_extended_id=False, is_error_frame=True)
    remote = can.Message(arbitration_id=256, is_extended_id=False, is_remote_frame=True, dlc=8)
    others = [frame(257, data), frame(256, data, extended=True), frame(512, data), error, remote]
    messages = [*others, frame(256, data), frame(512, data, extended=True)]
    frames = decoder.gather(messages, range(len(messages)))
    assert frames.plan.size == 2
    assert decoder.decode(frames).channel.tolist() == [0, 1]


def test_a_database_holds_on_its_own_bus(tmp_path):
    one, two = dbc(tmp_path, name="one.dbc"), dbc(tmp_path, name="two.dbc")
    two.write_text(two.read_text().replace("ENGINE", "MOTOR").replace("(0.1,-40)", "(1,0)"))
    channels = [sensor(0, "ENGINE", "Temp"), sensor(1, "MOTOR", "Temp")]
    decoder = Decoder([(one, 1), (two, 2)], channels, width=1)
    data = bytes.fromhex("f401") + bytes(6)
    messages = [frame(256, data, bus=bus) for bus in (1, 2, "can1", "can2", 3, "can3", "vcan")]
    batch = decoded(decoder, messages)
    assert batch.channel.tolist() == [0, 1, 0, 1]
    assert batch.value[:, 0].tolist() == [10.0, 500.0, 10.0, 500.0]
    with pytest.raises(SourceError, match=r"ENGINE and MOTOR \(two.dbc\) have the same id 0x100; say on which bus"):
        Decoder([(one, None), (two, 2)], channels, width=1)


def test_a_float_that_is_nan_and_one_that_is_infinite_are_missing(tmp_path):
    decoder = decoding(tmp_path, [sensor(0, "WIDE", "Ratio")])
    values = [1.5, np.nan, np.inf, -np.inf]
    messages = [frame(512, np.float64(v).tobytes(), extended=True) for v in values]
    batch = decoded(decoder, messages)
    np.testing.assert_array_equal(batch.value[:, 0], [1.5, np.nan, np.nan, np.nan])


def test_positions_become_metres_from_the_first_valid_fix(tmp_path):
    reports = Reports()
    channel = sensor(0, "FIX", "Lat", "Lon", convert="east_north", model_units=("m", "m"))
    decoder = decoding(tmp_path, [channel], width=2, report=reports)
    fixes = [(200.0, 10.0), (56.0, 10.0), (56.001, 10.0), (56.0, 10.001)]
    raw = [np.round(np.array(fix) * 1e7).astype("<i4").tobytes() for fix in fixes]
    batch = decoded(decoder, [frame(258, data) for data in raw])
    assert np.isnan(batch.value[0]).all()
    np.testing.assert_array_equal(batch.value[1], [0.0, 0.0])
    assert batch.value[2] == pytest.approx([0.0, 111.342], abs=0.01)
    assert batch.value[3] == pytest.approx([62.393, 0.0], abs=0.01)
    later = decoded(decoder, [frame(258, raw[2])])
    np.testing.assert_array_equal(later.value[0], batch.value[2])


@cases(__file__, "dbc_lacks.csv")
def test_what_the_dbc_lacks_is_one_line(tmp_path, message, signal, where, unit, expected):
    more = {"where": (Condition(where, 1, 1),)} if where else {}
    channel = sensor(0, message, signal, **more, **({"model_units": (unit,)} if unit else {}))
    assert error_of(SourceError, decoding, tmp_path, [channel]).startswith(expected)


@pytest.mark.parametrize("text", ["", "BO_ nonsense", "\x00\x01"])
def test_a_file_that_is_no_dbc_is_one_line(tmp_path, text):
    path = dbc(tmp_path, text)
    assert str(path.name) in error_of(SourceError, Decoder, [(path, None)], [sensor(0, "ENGINE", "Temp")], width=1)
    with pytest.raises(SourceError, match="check the path of the DBC"):
        Decoder([(tmp_path / "absent.dbc", None)], [], width=1)


def test_both_messages_of_one_name_feed_the_channel(data):
    path = data("can_css_ev6_bms_uds", "dbc", "gnss.dbc")
    decoder = Decoder([(path, None)], [sensor(0, "gnss_imu", "AccelerationX")], width=1)
    assert sorted(decoder.wanted) == [9, 25]


def test_a_recording_decodes_as_cantools_does(data):
    """Every frame of ten seconds of a car's log, all signals of four messages."""
    path = data("can_comma2k19_rav4", "dbc", "toyota_2017.dbc")
    database = cantools.database.load_file(path, strict=False)
    names = ("WHEEL_SPEEDS", "KINEMATICS", "STEER_ANGLE_SENSOR", "SPEED")
    signals = {name: tuple(s.name for s in database.get_message_by_name(name).signals) for name in names}
    width = max(map(len, signals.values()))
    decoder = Decoder([(path, 0)], [sensor(k, n, *signals[n]) for k, n in enumerate(names)], width=width)
    ids = {database.get_message_by_name(n).frame_id: k for k, n in enumerate(names)}
    messages = []
    for message in can.LogReader(data("can_comma2k19_rav4", "rav4_2018-08-02_seg40.blf")):
        messages.append(message)
        if len(messages) == 16000:
            break
    batch = decoded(decoder, messages)
    wanted = [m for m in messages if m.channel == 0 and m.arbitration_id in ids]
    assert len(batch) == len(wanted) > 2000
    for message, k, row in zip(wanted, batch.channel, batch.value, strict=True):
        assert ids[message.arbitration_id] == k
        found = database.decode_message(message.arbitration_id, message.data, decode_choices=False)
        theirs = [float(found[name]) for name in signals[names[k]]]
        assert row[: len(theirs)].tolist() == theirs


def test_a_frame_brings_the_noise_of_its_reading(tmp_path):
    """Squared, in columns of their own; zero or cut off it leaves the tuned R, unknown it leaves the value out."""
    reports, database = Reports(), dbc(tmp_path, DBC + 'VAL_ 256 Torque 2 "SNA" ;\n')
    accuracy = Accuracy(("Torque",), units=("cm",), scale=(0.5,))
    fix = Channel(
        READING, 0, "engine", ("Temp", "Rpm"), "ENGINE", units=("m", "m"), model_units=("m", "m"), accuracy=accuracy
    )
    decoder = Decoder([(database, None)], [fix, sensor(1, "FIX", "Lat")], width=3, report=reports)
    database = cantools.database.load_file(database, strict=False)
    data = [
        database.encode_message("ENGINE", {"Temp": 20.0, "Rpm": 800.0, "Torque": torque, "Ok": 1})
        for torque in (300.0, 0.0, -5.0, 1.0)
    ]
    frames = [frame(256, item) for item in (*data, data[0][:4])] + [frame(258, bytes(8))]
    batch = decoded(decoder, frames)
    nan = np.nan
    np.testing.assert_allclose(
        batch.value,
        [
            [20.0, 800.0, nan, (0.01 * 300.0 * 0.5) ** 2, (0.01 * 300.0 * 0.5) ** 2],
            [20.0, 800.0, nan, nan, nan],
            [nan, nan, nan, nan, nan],
            [nan, nan, nan, nan, nan],
            [20.0, 800.0, nan, nan, nan],
            [0.0, nan, nan, nan, nan],
        ],
        rtol=1e-14,
    )
    assert reports.counts == {"accuracy engine": 2, "unknown accuracy engine": 2, "no value ENGINE.Torque": 1}
    assert reports.texts["accuracy engine"].startswith(
        "engine: Torque has no positive standard deviation of a measurement"
    )


def test_an_accuracy_is_no_value_of_its_sensor(tmp_path):
    """A fix at 200° of latitude is missing, however accurate."""
    accuracy = Accuracy(("Torque",), units=("m",))
    place = Channel(
        READING, 0, "gnss", ("Temp", "Rpm"), "ENGINE", units=("deg", "deg"), model_units=("m", "m"),
        convert="east_north", accuracy=accuracy,
    )  # fmt: skip
    decoder = decoding(tmp_path, [place], width=2)
    database = cantools.database.load_file(dbc(tmp_path), strict=False)
    for latitude, missing in ((200.0, True), (50.0, False)):
        data = database.encode_message("ENGINE", {"Temp": latitude, "Rpm": 10.0, "Torque": 3.0, "Ok": 1})
        batch = decoded(decoder, [frame(256, data)])
        assert np.isnan(batch.value[0, :2]).all() == missing == bool(decoder.expected)
    np.testing.assert_array_equal(batch.value, [[0.0, 0.0, 9.0, 9.0]])


@pytest.mark.parametrize(("unit", "square"), [("m^2", 1.0), ("cm^2", 1e-4), ("m²", 1.0)])
def test_variances_convert_by_the_square(tmp_path, unit, square):
    accuracy = Accuracy(("Torque",), squared=True, units=(unit,), scale=(2.0,))
    fix = Channel(READING, 0, "engine", ("Temp",), "ENGINE", units=("m",), model_units=("m",), accuracy=accuracy)
    decoder = decoding(tmp_path, [fix])
    database = cantools.database.load_file(dbc(tmp_path), strict=False)
    data = database.encode_message("ENGINE", {"Temp": 20.0, "Rpm": 0.0, "Torque": 3.0, "Ok": 1})
    batch = decoded(decoder, [frame(256, data)])
    np.testing.assert_allclose(batch.value, [[20.0, 6.0 * square]], rtol=1e-12)


def test_an_accuracy_of_another_dimension_is_refused(tmp_path):
    accuracy = Accuracy(("Torque",), squared=True, units=("m",))
    fix = Channel(READING, 0, "engine", ("Temp",), "ENGINE", units=("m",), model_units=("m",), accuracy=accuracy)
    with pytest.raises(SourceError, match=r"engine: Torque: 'm' does not convert to the model's '\(m\)\*\*2'"):
        decoding(tmp_path, [fix])


@cases(__file__, "limits.csv")
def test_values_that_the_dbc_or_j1939_excludes_are_missing_and_named(
    tmp_path, layout, limits, names, j1939, raw, value, why, ends
):
    lines = [f'BO_ 2147484160 A: 8 E\n SG_ S : 0|{layout} {limits} "" E']
    lines += [f"VAL_ 2147484160 S {names} ;"] * bool(names)
    lines += ['BA_DEF_ "ProtocolType" STRING ;', 'BA_ "ProtocolType" "J1939";'] * bool(j1939)
    path, reports = dbc(tmp_path, "\n".join(lines) + "\n"), Reports()
    channel = sensor(0, "A", "S", scale=(0.5,), offset=(1.0,))
    assert ends_of([(path, None)], channel) == (tuple(0.5 * float(end) + 1.0 for end in ends.split()),)
    decoder = Decoder([(path, None)], [channel], width=1, report=reports)
    data = int(raw).to_bytes(8, "little")
    (found,) = decoded(decoder, [frame(512, data, extended=True)]).value[:, 0]
    np.testing.assert_equal(found, 0.5 * float(value or "nan") + 1.0)
    assert reports.counts["no value A.S"] == (not value) and why in str(reports.texts)
