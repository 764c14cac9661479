"""Live buses: frames arrive decoded; a bus that fails is reported and opened again, and `read` never raises."""

import os
import socket
import sys
import time
import uuid

import can
import pytest

from estimators.errors import SourceError
from estimators.log import Events
from sources.can.bus import LOSS_PERIOD_S, RECONNECT_WAITS_S, CanBus, open_bus
from sources.can.decoder import Decoder
from tests.sources.can.can_tools import DBC, Reports, dbc, decoding, frame, sensor
from tests.support import Clock, error_of, free_port
from tests.waiting import wait_for

DATA = bytes.fromhex("f4010fa000000080")
GROUP = "239.74.163.2"


class FakeBus:
    """Gives what the script says: a message, None for silence, or an error to raise."""

    def __init__(self, script):
        self.script = list(script)
        self.closed = False

    def recv(self, timeout):
        item = self.script.pop(0) if self.script else None
        if isinstance(item, Exception):
            raise item
        return item

    def shutdown(self):
        self.closed = True


@pytest.fixture
def decoder(tmp_path):
    return decoding(tmp_path, [sensor(0, "ENGINE", "Temp")])


def listen(bus, count):
    """Read until `count` events came."""
    batches = []

    def heard():
        batches.append(bus.read(0.1))
        return sum(map(len, batches)) >= count

    wait_for(heard)
    return Events.concat(batches, 1)


def test_frames_of_a_virtual_bus_arrive_decoded_in_order(decoder):
    name = uuid.uuid4().hex
    source = CanBus("virtual", name, decoder)
    before = time.time_ns()
    with can.Bus(interface="virtual", channel=name) as other:
        for k in range(3000):
            other.send(frame(256, k.to_bytes(2, "little") + DATA[2:]))
            other.send(frame(257, DATA))
    got = listen(source, 3000)
    after = time.time_ns()
    assert [round(10 * (value + 40)) for value in got.value[:, 0]] == list(range(3000))
    assert before - 1000 <= got.t.min() and got.t.max() <= after  # a float of seconds has 0.24 µs steps
    assert before <= got.arrival.min() and got.arrival.max() <= after
    assert (got.arrival >= got.t - 1000).all()
    assert source.live and before <= source.now()
    assert len(source.read(0.0)) == 0
    source.close()
    assert source.read(0.0) is None


def test_what_is_queued_is_taken_at_once(decoder):
    script = [frame(256, DATA, t=k) for k in range(1, 101)]
    source = CanBus("fake", 0, decoder, connect=lambda: FakeBus(script))
    assert len(source.read(0.0)) == 100
    assert len(source.read(0.0)) == 0


def test_a_bus_that_cannot_be_opened_is_one_line(decoder):
    for interface, channel in (("no_such", 0), ("socketcan", "no_such_can"), ("udp_multicast", "not a group")):
        text = error_of(SourceError, CanBus, interface, channel, decoder)
        assert text.startswith(f"CAN bus {interface}:{channel}: it cannot be opened")


def test_one_bad_packet_is_counted_and_the_bus_stays(decoder):
    reports, bus = Reports(), FakeBus([frame(256, DATA), can.CanOperationError("garbled"), frame(256, DATA), None])
    source = CanBus("fake", 0, decoder, report=reports, connect=lambda: bus)
    assert len(source.read(0.0)) == 1, "what came before the fault is kept"
    assert len(source.read(0.0)) == 1
    assert reports.counts == {"bus error": 1} and reports.texts["bus error"] == "CAN bus fake:0: garbled"
    assert not bus.closed


def test_a_bus_that_fails_is_opened_again_with_longer_and_longer_waits(decoder):
    reports, clock = Reports(), Clock(100.0)
    gone = [OSError("network is down"), OSError("network is down")]
    first, last = FakeBus([frame(256, DATA), *gone]), FakeBus([frame(256, DATA)])
    answers = [first, SourceError("no"), SourceError("no"), last]
    opened_at = []

    def connect():
        opened_at.append(clock.now)
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    source = CanBus("fake", 0, decoder, report=reports, connect=connect, clock=clock)
    assert len(source.read(0.0)) == 1
    assert len(source.read(0.0)) == 0 and first.closed
    for _ in range(20):
        got = source.read(0.0)
        if len(got):
            break
        clock.now += 0.05
    assert len(got) == 1
    waits = [b - a for a, b in zip(opened_at, opened_at[1:], strict=False)]
    # Attempts fall on the first read after their time; reads come every 0.05 s here.
    assert waits == pytest.approx(RECONNECT_WAITS_S[:3], abs=0.051)
    assert reports.counts == {"bus error": 4, "bus reconnected": 1}
    assert "next attempt in 0.5 s" in reports.texts["bus error"]


def test_error_frames_are_counted_and_give_no_event(decoder):
    reports = Reports()
    script = [can.Message(is_error_frame=True, arbitration_id=256, is_extended_id=False), frame(256, DATA)]
    source = CanBus("fake", 0, decoder, report=reports, connect=lambda: FakeBus(script))
    assert len(source.read(0.0)) == 1
    assert reports.counts == {"error frame": 1}


@pytest.fixture
def multicast():
    """Open real multicast buses on a port of this test, by group; they are closed at the end."""
    opened, port = [], free_port(socket.SOCK_DGRAM)

    def connect(group, **arguments):
        try:
            opened.append(open_bus("udp_multicast", group, {"port": port}, **arguments))
            opened[-1].send(frame(2047, b"probe"))
        except (SourceError, can.CanError) as error:
            pytest.skip(f"no multicast here: {error}")
        return opened[-1]

    yield connect
    for bus in opened:
        bus.shutdown()


def test_multicast_stays_on_this_machine_and_arrives(decoder, multicast):
    source = CanBus("udp_multicast", GROUP, decoder, connect=lambda: multicast(GROUP, filters=decoder.filters))
    sender = multicast(GROUP)
    sender.send(frame(256, DATA))
    assert sender._multicast.hop_limit == 0
    assert listen(source, 1).value[0, 0] == 10.0


@pytest.mark.skipif(sys.platform != "linux", reason="a socket option of Linux")
def test_frames_that_the_socket_drops_are_counted_and_named(decoder, multicast):
    clock, reports, sent = Clock(100.0), Reports(), 3000
    listener, sender = multicast(GROUP), multicast(GROUP)
    with socket.socket(fileno=os.dup(listener.fileno())) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    while listener.recv(0.0) is not None:  # the probes
        pass
    source = CanBus("udp_multicast", GROUP, decoder, report=reports, connect=lambda: listener, clock=clock)
    assert len(source.read(0.0)) == 0
    for _ in range(sent):
        sender.send(frame(256, DATA))
    clock.now += LOSS_PERIOD_S
    received = len(source.read(0.0))
    assert 0 < received < sent
    lost = sent - received
    expected = f"{100 * lost / sent:.2g} % of frames dropped by the socket ({lost:,} of {sent:,}; {lost:,} in all)"
    assert expected in reports.texts["frames lost"]
    clock.now += LOSS_PERIOD_S
    source.read(0.0)
    assert reports.counts == {"frames lost": 1}


@pytest.mark.skipif(sys.platform != "linux", reason="a socket option of Linux")
@pytest.mark.parametrize("groups", [(GROUP, "239.74.163.3"), ("ff15::4e49:1", "ff15::4e49:2")], ids=["IPv4", "IPv6"])
def test_two_groups_on_one_host_are_two_buses(multicast, groups):
    listeners = [multicast(group) for group in groups]
    senders = [multicast(group) for group in groups]
    for k, sender in enumerate(senders):
        for count in range(3):
            sender.send(frame(256 + k, bytes([count])))
    for k, listener in enumerate(listeners):
        received = []
        while len(received) < 3 and (message := listener.recv(5.0)) is not None:
            received += [(message.arbitration_id, *message.data)] if message.arbitration_id != 2047 else []
        assert received == [(256 + k, 0), (256 + k, 1), (256 + k, 2)]
        assert all(other.arbitration_id == 2047 for other in iter(lambda bus=listener: bus.recv(0.0), None))


def test_a_message_that_never_comes_is_named_once(tmp_path):
    """After some seconds in which others came, or after three of its periods if the DBC tells them."""
    clock, reports = Clock(100.0), Reports()
    text = DBC + 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_DEF_DEF_ "GenMsgCycleTime" 0;\n'
    slow = dbc(tmp_path, text + 'BA_ "GenMsgCycleTime" BO_ 258 10000;\n')
    channels = [sensor(0, "ENGINE", "Temp"), sensor(1, "WIDE", "Ratio"), sensor(2, "FIX", "Lat")]
    bus = FakeBus([])
    source = CanBus(
        "x", "y", Decoder([(slow, None)], channels, width=1), report=reports, connect=lambda: bus, clock=clock
    )
    source.read(0.0)
    clock.now += 6.0
    source.read(0.0)
    assert reports.counts == {"never seen": 1}
    assert reports.texts["never seen"].startswith(
        "CAN bus x:y: none of ENGINE (0x100), WIDE (0x200x), FIX (0x102) was received"
    )
    bus.script = [frame(256, DATA), None]
    source.read(0.0)
    reports.counts.clear()
    for _ in range(4):
        clock.now += 2.0
        bus.script = [frame(256, DATA), None]
        source.read(0.0)
    assert reports.counts == {"never seen": 1}
    assert reports.texts["never seen"].startswith(
        "CAN bus x:y: after 6 s WIDE (0x200x) was never received, so sensor1 has"
    )
    for _ in range(20):
        clock.now += 2.0
        source.read(0.0)
    assert reports.counts == {"never seen": 2}
    assert (
        "FIX (0x102) was never received" in reports.texts["never seen"] and "after 30 s" in reports.texts["never seen"]
    )
    source.close()
