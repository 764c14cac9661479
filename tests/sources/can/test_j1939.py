"""J1939: messages by parameter group and sender, and those of several packets."""

import struct

import numpy as np
import pytest
from cantools.j1939 import frame_id_pack

from app.study.advice.draft import _channel
from app.study.advice.signals import signals
from estimators.errors import SourceError
from sources.can.decoder import Decoder
from sources.can.log import CanLog
from sources.inspect import inspect_recordings
from tests.sources.can.can_tools import Reports, dbc, decoded, frame, sensor
from tests.sources.can.test_log import write
from tests.support import error_of, read_all

PROTOCOL = 'BA_DEF_ "ProtocolType" STRING ;\nBA_ "ProtocolType" "J1939";\n'
EEC1, LONG, TSC1, BRAKE = 0xCF004FE, 0x18FEDAFE, 0xC0000FE, 0x18F00100


def database(tmp_path, ids=(EEC1,), protocol=PROTOCOL, name="j.dbc"):
    """EEC1 by SAE J1939-71 (PGN 61444), a message of 20 bytes, TSC1 to one node, and one with a standard id."""
    rows = {
        EEC1: 'EEC1: 8 E\n SG_ Rpm : 24|16@1+ (0.125,0) [0|8031.875] "rpm" E',
        LONG: 'LONG: 20 E\n SG_ First : 0|16@1+ (1,0) [0|0] "" E\n SG_ Last : 144|16@1+ (1,0) [0|0] "" E',
        TSC1: 'TSC1: 8 E\n SG_ Rpm : 8|16@1+ (0.125,0) [0|0] "rpm" E',
        0x100: 'PLAIN: 8 E\n SG_ Rpm : 0|16@1+ (1,0) [0|0] "rpm" E',
    }
    known = {key & ~0xFF: text for key, text in rows.items() if key > 0x7FF} | {0x100: rows[0x100]}
    lines = ["BU_: E"]
    for number, key in enumerate(ids):
        text = known[key & ~0xFF if key > 0x7FF else key]
        text = text if number == list(ids).index(key) and key in rows else text.replace(":", f"_{key & 0xFF:02X}:", 1)
        lines.append(f"BO_ {key | (1 << 31 if key > 0x7FF else 0)} {text}")
    return dbc(tmp_path, "\n".join(lines) + "\n" + protocol, name)


def decoder_of(path, *channels, report=lambda key, text: None):
    return Decoder([(path, None)], channels, width=1, report=report)


def rpm(value, source=0, *, priority=3, t=1.0, pf=0xF0, ps=4):
    """A frame of EEC1 by cantools' packing of the id; the rest is not available (0xFF)."""
    key = frame_id_pack(priority, 0, 0, pf, ps, source)
    place = b"\xff" * (3 if pf == 0xF0 else 1)
    return frame(key, (place + struct.pack("<H", round(value / 0.125))).ljust(8, b"\xff"), t=t, extended=True)


def packets(payload, pgn=0xFEDA, source=0, destination=0xFF, t=1.0, step=0.05):
    """TP.CM and TP.DT of a payload, by SAE J1939-21: BAM to all nodes, or RTS to one."""
    count = -(-len(payload) // 7)
    head = struct.pack("<BHBB", 32 if destination == 0xFF else 16, len(payload), count, 0xFF) + pgn.to_bytes(
        3, "little"
    )
    rows = [bytes([k + 1]) + payload[7 * k : 7 * k + 7].ljust(7, b"\xff") for k in range(count)]
    forms = [0xEC] + [0xEB] * count
    return [
        frame(frame_id_pack(7, 0, 0, form, destination, source), data, t=round(t + step * k, 6), extended=True)
        for k, (form, data) in enumerate(zip(forms, [head, *rows], strict=True))
    ]


def payload(k):
    return struct.pack("<H16xH", 1000 + k, 2000 + k)


@pytest.mark.parametrize(
    ("ids", "protocol", "fits"),
    [
        ([EEC1], PROTOCOL, [True, True, True, False]),
        ([EEC1], "", [True, True, True, False]),  # by the form of its id
        ([0xCF00400], PROTOCOL, [True, True, True, False]),
        ([0xCF00400], "", [True, False, False, False]),
        ([0xCF00400, 0xCF00403], PROTOCOL, [True, False, True, False]),  # told apart by their addresses
    ],
)
def test_a_message_fits_its_parameter_group(tmp_path, ids, protocol, fits):
    path = database(tmp_path, ids, protocol)
    name = "EEC1" if ids[0] == EEC1 else "EEC1_00"
    frames = [rpm(800), rpm(800, 3), rpm(800, priority=6), rpm(800, ps=5)]
    got = [len(decoded(decoder_of(path, sensor(0, name, "Rpm")), [one])) == 1 for one in frames]
    assert got == fits


def test_two_senders_are_two_channels_and_never_mixed(tmp_path):
    path, reports = database(tmp_path), Reports()
    frames = [rpm(800, 0), rpm(1200, 3), rpm(808, 0), rpm(1208, 3, priority=6)]
    both = decoder_of(path, sensor(0, "EEC1", "Rpm", source=0), sensor(1, "EEC1", "Rpm", source=3))
    got = decoded(both, frames)
    assert got.channel.tolist() == [0, 1, 0, 1] and got.value[:, 0].tolist() == [800, 1200, 808, 1208]
    one = decoder_of(path, sensor(0, "EEC1", "Rpm"), report=reports)
    assert decoded(one, frames).value[:, 0].tolist() == [800] and len(decoded(one, frames)) == 0
    line = "EEC1 (PGN 61444) is sent by 0x00, 0x03; give sensor0 one of them, such as source: 0x00"
    assert reports.texts["never seen"] == line
    own = decoder_of(database(tmp_path, [0xCF00400], name="own.dbc"), sensor(0, "EEC1_00", "Rpm"), report=reports)
    assert decoded(own, frames).value[:, 0].tolist() == [800, 808]
    assert "takes that of 0x00, as the DBC has it" in reports.texts["never seen"]
    mixed = [sensor(0, "EEC1", "Rpm"), sensor(1, "EEC1", "Rpm", source=3)]
    assert error_of(SourceError, decoder_of, path, *mixed) == (
        "sensor0: another channel of EEC1 has a source; give one here, too"
    )


@pytest.mark.parametrize("suffix", [".log", ".blf", ".mf4", ".asc"])
def test_a_log_with_two_senders_is_refused_or_read_by_source(tmp_path, suffix):
    path, log = database(tmp_path, [EEC1, 0x100]), tmp_path / f"two{suffix}"
    write(log, [frame(0x300, bytes(8)), rpm(800, 0), rpm(1200, 3, t=1.1), frame(0x100, b"\x07\0", t=1.2)])
    whole = CanLog([log], decoder_of(path, sensor(0, "EEC1", "Rpm")))
    assert error_of(SourceError, read_all, whole).startswith(f"{log}: EEC1 (PGN 61444) is sent by 0x00, 0x03; give")
    channels = [sensor(0, "EEC1", "Rpm", source=3), sensor(1, "PLAIN", "Rpm")]
    got = read_all(CanLog([log], decoder_of(path, *channels)))
    assert got.value[:, 0].tolist() == [1200, 7]
    found = inspect_recordings([log], [(path, None)])
    assert [(m.name, m.key & 0xFF) for m in found.messages] == [("PLAIN", 0), (None, 0), ("EEC1", 0), ("EEC1", 3)]
    lines = [_channel("rpm", one) for one in signals(found)]
    assert lines[1:] == [f'  rpm: {{message: "EEC1", signals: "Rpm", source: 0x0{k}}}' for k in (0, 3)]


def test_a_source_that_is_absent_or_impossible_is_one_line(tmp_path):
    path = database(tmp_path, [EEC1, 0x100])
    plain = decoder_of(path, sensor(0, "EEC1", "Rpm", source=9))
    (item,) = plain.expected
    assert plain.missing(item, {("can0", 1 << 31 | 0xCF00403): 2}) == [
        "EEC1 (PGN 61444 from source 0x09) was never received, so sensor0 has no values; its PGN was received from "
        "0x03; if that is the message of J1939, give the channel source: 0x03"
    ]
    text = error_of(SourceError, decoder_of, path, sensor(0, "PLAIN", "Rpm", source=0))
    assert text == "sensor0: source: PLAIN has a standard id, without a source address"


def test_a_message_to_one_node_takes_the_destination_of_the_dbc(tmp_path):
    """TSC1 (PGN 0) of the transmission, to the engine and to the retarder."""
    path, reports = database(tmp_path, [TSC1]), Reports()
    frames = [rpm(to, 11, pf=0, ps=to) for to in (0, 15)]
    decoder = decoder_of(path, sensor(0, "TSC1", "Rpm"), report=reports)
    assert decoded(decoder, frames[:1]).value[:, 0].tolist() == [0]
    decoded(decoder, frames)
    assert decoded(decoder, frames).value[:, 0].tolist() == [0]
    assert "sent by 0x0b to 0x00, 0x0b to 0x0f; sensor0 takes that of 0x0b to 0x00" in str(reports.texts)


def test_filters_of_a_bus_pass_the_group_and_its_transport(tmp_path):
    decoder = decoder_of(database(tmp_path, [EEC1, TSC1]), sensor(0, "EEC1", "Rpm"), sensor(1, "TSC1", "Rpm"))
    passed = [(f["can_id"], f["can_mask"]) for f in decoder.filters if f["extended"]]
    assert passed == [(0, 0x3FF0000), (0xEB0000, 0x3FF0000), (0xEC0000, 0x3FF0000), (0xF00400, 0x3FFFF00)]


def test_messages_of_several_packets_decode_at_their_last_packet(tmp_path):
    """BAM and RTS of two senders at the same time, with the frames that the receiver sends in between."""
    path = database(tmp_path, [LONG, EEC1])
    channels = [sensor(k, "LONG", "First" if k % 2 else "Last", source=k // 2) for k in range(4)]
    bam, rts = packets(payload(1)), packets(payload(2), source=1, destination=0x21, t=1.01)
    answer = frame(frame_id_pack(7, 0, 0, 0xEC, 1, 0x21), bytes.fromhex("110301ffffdafe00"), t=1.02, extended=True)
    frames = sorted([*bam, *rts, answer, rpm(800)], key=lambda one: one.timestamp)
    got = decoded(decoder_of(path, *channels), frames)
    want = [(0, 1.15, 2001), (1, 1.15, 1001), (2, 1.16, 2002), (3, 1.16, 1002)]
    assert [(c, t / 1e9, v) for c, t, v in zip(got.channel, got.t, got.value[:, 0], strict=True)] == want
    for suffix in (".log", ".blf", ".mf4"):
        write(tmp_path / f"a{suffix}", frames)
        log = CanLog([tmp_path / f"a{suffix}"], decoder_of(path, *channels))
        np.testing.assert_array_equal(read_all(log).value, got.value)
    found = inspect_recordings([tmp_path / "a.log"], [(path, None)])
    named = {m.key: [(s.column, s.values.tolist()) for s in m.signals] for m in found.messages if m.name == "LONG"}
    assert named == {1 << 31 | 0x1CFEDA00 + k: [("First", [1001 + k]), ("Last", [2001 + k])] for k in (0, 1)}
    assert found.t.size == len(frames)


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_a_message_that_lacks_a_packet_is_left_out_and_counted(tmp_path, lost):
    path, reports = database(tmp_path, [LONG]), Reports()
    decoder = decoder_of(path, sensor(0, "LONG", "Last"), report=reports)
    first, second = packets(payload(1)), packets(payload(2), t=2.0)
    assert decoded(decoder, first[:lost] + first[lost + 1 :] + second).value[:, 0].tolist() == [2002]
    assert reports.counts == {"incomplete message": 1}
    assert reports.texts["incomplete message"] == (
        f"PGN 65242 from source 0x00: {lost - 1} of 3 packets were received in time and in order; "
        "the message is left out"
    )


def test_an_announcement_with_a_wrong_number_of_packets_is_counted(tmp_path):
    reports = Reports()
    decoder = decoder_of(database(tmp_path, [LONG]), sensor(0, "LONG", "Last"), report=reports)
    frames = packets(payload(1))
    frames[0].data[3] = 2
    assert len(decoded(decoder, frames)) == 0 and reports.counts == {"incomplete message": 1}


def test_packets_of_two_messages_are_not_joined(tmp_path):
    """The end of one and the announcement of the next are lost: the gap is longer than T1."""
    decoder = decoder_of(database(tmp_path, [LONG]), sensor(0, "LONG", "Last"))
    assert len(decoded(decoder, packets(payload(1))[:2] + packets(payload(2), t=2.0)[2:])) == 0


def test_a_packet_that_is_sent_again_counts_once(tmp_path):
    decoder = decoder_of(database(tmp_path, [LONG]), sensor(0, "LONG", "Last"))
    frames = packets(payload(1), destination=0x21)
    assert decoded(decoder, [*frames[:2], frames[1], frames[3], frames[2]]).value[:, 0].tolist() == [2001]
