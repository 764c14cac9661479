"""Frames read from the socket are those of python-can, to the last bit of their times; so are the refused ones."""

import os
import random
import socket
import struct
import sys

import can
import msgpack
import pytest
from can.interfaces.socketcan import socketcan
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from estimators.log import Events
from sources.can.bus import CanBus
from sources.can.sockets import CMSG_TIME, Frame, frame_socket, multicast_parser
from tests.sources.can.can_tools import Reports, decoding, frame, same, sensor
from tests.sources.can.test_bus import multicast  # noqa: F401  a fixture
from tests.waiting import wait_for

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="sockets of Linux")

GROUP = f"239.75.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
"""Of this process alone: each frame counts here."""

FD_LENGTHS = (0, 3, 8, 12, 16, 20, 24, 32, 48, 64)


def random_message(rng):
    """Any frame of a bus: standard, extended, remote, error or FD."""
    extended, kind = rng.random() < 0.4, rng.choice(["data", "data", "data", "remote", "error", "fd"])
    length = rng.choice(FD_LENGTHS) if kind == "fd" else rng.randrange(9)
    return can.Message(
        arbitration_id=rng.choice([256, 258, 259, 512, rng.randrange(2**29 if extended else 2**11)]),
        is_extended_id=extended,
        is_remote_frame=kind == "remote",
        is_error_frame=kind == "error",
        is_fd=kind == "fd",
        bitrate_switch=kind == "fd" and rng.random() < 0.5,
        data=None if kind == "remote" else rng.randbytes(length),
        dlc=length,
        channel=rng.choice([None, "can0", 1]),
        timestamp=rng.random(),
    )


def fields(message):
    return [bytes(getattr(message, name)) if name == "data" else getattr(message, name) for name in Frame._fields]


@pytest.fixture
def decoder(tmp_path):
    channels = [sensor(0, "ENGINE", "Temp"), sensor(1, "WIDE", "Ratio"), sensor(2, "FIX", "Lat", "Lon")]
    return lambda report: decoding(tmp_path, channels, width=2, report=report)


def test_events_of_multicast_are_those_of_python_can(decoder, multicast):  # noqa: F811
    buses, sender, reports = [multicast(GROUP), multicast(GROUP)], multicast(GROUP), [Reports(), Reports()]

    def stamped_on_arrival():
        sender.send(frame(2047, b""))
        return len({last_of(bus).timestamp for bus in buses}) == 1

    # The kernel begins some moments after the first socket asks for it, later the busier the machine is.
    wait_for(stamped_on_arrival)
    sources = [
        CanBus(name, GROUP, decoder(report), report=report, connect=lambda bus=bus: bus)
        for name, bus, report in zip(("udp_multicast", "python-can"), buses, reports, strict=True)
    ]
    assert [source._socket is not None for source in sources] == [True, False]
    rng, batches = random.Random(5), ([], [])
    for _ in range(40):
        for _ in range(50):
            sender.send(random_message(rng))
        for source, own in zip(sources, batches, strict=True):
            own.append(source.read(5.0))
    end = b"\x11\x22" * 4
    sender.send(frame(256, end))
    for source, own in zip(sources, batches, strict=True):
        # The last frames may arrive after the last read.
        while not any(round(value, 1) == 832.1 for batch in own[-2:] for value in batch.value[-1:, 0]):
            own.append(source.read(5.0))
    ours, theirs = (Events.concat(own, 2) for own in batches)
    assert len(ours) > 400
    assert same(ours._replace(arrival=theirs.arrival), theirs) and (ours.arrival >= ours.t - 1000).all()
    assert reports[0].counts == reports[1].counts and reports[0].counts["error frame"] > 100


def last_of(bus):
    message = bus.recv(5.0)
    while (more := bus.recv(0.0)) is not None:
        message = more
    return message


MUTATIONS = {
    "arbitration_id": [-1, 2**11, 2**29, 256.0, True, None, "a", [1]],
    "is_extended_id": [1, 0, None, "x"],
    "is_remote_frame": [True],
    "is_error_frame": [True, 1],
    "channel": ["can1", 2, 1.5],
    "dlc": [9, 3, -1, None, 8.0],
    "data": [None, b"", b"123456789", "12345678", [1, 2, 3, 4, 5, 6, 7, 8], 8],
    "is_fd": [True, 1, None],
    "bitrate_switch": [True, 1],
    "error_state_indicator": [True],
    "timestamp": [None, -1.0, "x"],
    "is_rx": [False],
    "check": [False],
    "unknown": [1],
}


@pytest.mark.parametrize("key", MUTATIONS)
def test_a_packet_is_taken_or_refused_as_by_python_can(key):
    parse = multicast_parser(fd_bus(True))
    for extended in (True, False):
        good = msgpack.unpackb(pack_message(frame(256, b"12345678", extended=extended)))
        for value in MUTATIONS[key]:
            packet = msgpack.packb(good | {key: value})
            try:
                wanted = fields(unpack_message(packet, replace={"timestamp": 1.25}, check=True))
                wanted[2] = bool(wanted[2])  # Only its truth counts
            except Exception:
                wanted = None
            if key == "arbitration_id" and isinstance(value, float):
                wanted = None  # No database has it
            try:
                found = fields(parse(packet, 1.25, None))
                found[2] = bool(found[2])
            except can.CanOperationError as error:
                assert str(error) == "could not unpack received message"
                found = None
            assert found == wanted, (value, extended)


def fd_bus(fd):
    class Bus:
        protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    return Bus()


GOOD = msgpack.unpackb(pack_message(frame(256, b"12345678")))
LISTED = msgpack.packb(GOOD | {"channel": [1]})
"""A list is no key of the decoder's table, and would end the reading."""


@pytest.mark.parametrize("packet", [b"", b"\xc1", b"\x91" * 3000, msgpack.packb([1]), msgpack.packb(None), LISTED])
def test_a_packet_that_is_no_frame_is_refused(packet):
    with pytest.raises(can.CanOperationError, match="could not unpack"):
        multicast_parser(fd_bus(True))(packet, 1.0, None)


def test_fd_frames_of_a_bus_without_fd_are_left_out():
    message = frame(256, bytes(12))
    message.is_fd = True
    assert multicast_parser(fd_bus(False))(pack_message(message), 1.0, None) is None
    assert multicast_parser(fd_bus(True))(pack_message(message), 1.0, None).is_fd


def test_a_multicast_bus_with_filters_of_its_own_stays_with_python_can(multicast):  # noqa: F811
    bus = multicast(GROUP, filters=[{"can_id": 1, "can_mask": 1}])
    assert frame_socket("udp_multicast", bus) is None and frame_socket("virtual", multicast(GROUP)) is None


@pytest.fixture
def socketcan_bus(monkeypatch):
    """A SocketCAN bus of python-can on a pair of local sockets, which carry frames of the same layout."""
    opened = []

    def connect(channel):
        far, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        with monkeypatch.context() as patch:
            patch.setattr(socketcan, "create_socket", lambda: near)
            patch.setattr(socketcan, "bind_socket", lambda sock, channel: None)
            bus = socketcan.SocketcanBus(channel, fd=True)
        opened.extend((far.close, bus.shutdown))
        return bus, far

    yield connect
    for close in opened:
        close()


def test_frames_of_socketcan_are_those_of_python_can(decoder, socketcan_bus):
    (plain, plain_end), (bus, far) = socketcan_bus("can0"), socketcan_bus("can0")
    frames = frame_socket("socketcan", bus)
    peek = socket.socket(fileno=socket.dup(bus.fileno()))
    rng, sent = random.Random(6), 0
    for _ in range(300):
        packet = bytearray(socketcan.build_can_frame(random_message(rng)))
        if len(packet) > 16 and rng.random() < 0.2:
            packet[4] = rng.randrange(65)  # A length that no frame on the wire has
        far.send(packet)
        plain_end.send(packet)
        _, ((_, _, stamp),), _, _ = peek.recvmsg(100, 100, socket.MSG_PEEK)
        seconds, nanoseconds = struct.unpack("@ll", stamp)
        (found,), wanted = frames.frames(1.0), plain.recv(1.0)
        assert fields(found)[1:] == fields(wanted)[1:]
        assert found.timestamp == seconds + nanoseconds * 1e-9 and seconds > CMSG_TIME.size
        sent += 1
    assert sent == 300 and list(frames.frames(0.0)) == []
    peek.close()
    frames.close()


def test_a_socketcan_bus_is_read_in_one_batch_with_its_channel(decoder, socketcan_bus):
    reports = Reports()
    bus, far = socketcan_bus("can0")
    source = CanBus("socketcan", "can0", decoder(reports), report=reports, connect=lambda: bus)
    for k in range(5):
        far.send(socketcan.build_can_frame(frame(256, k.to_bytes(8, "little"))))
    far.send(socketcan.build_can_frame(can.Message(is_error_frame=True, arbitration_id=4, dlc=8, data=bytes(8))))
    assert source.read(5.0).value[:, 0].round(6).tolist() == [-40.0, -39.9, -39.8, -39.7, -39.6]
    assert reports.counts == {"error frame": 1} and len(source.read(0.0)) == 0
    assert {bus for bus, _ in source._monitor._seen} == {"can0"}
    source.close()
    assert source.read(0.0) is None


def test_a_socket_that_ends_is_a_failure_of_the_bus(decoder, socketcan_bus):
    reports, (bus, _) = Reports(), socketcan_bus("can0")
    source = CanBus("socketcan", "can0", decoder(reports), report=reports, connect=lambda: bus)
    source._socket.close()
    for _ in range(2):
        assert len(source.read(0.0)) == 0
    assert reports.counts == {"bus error": 2} and source._bus is None
    source.close()
