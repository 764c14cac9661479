"""A live CAN bus: opened by python-can, read in batches."""

from __future__ import annotations

import os
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import islice

import can
from can import BusABC

from estimators.errors import SourceError
from estimators.log import Events

from ..source import LOST_FRAMES, NEVER, Report, ignore
from ..worker_process import gist
from .decoder import Decoder
from .ids import MessageIds
from .readers import EXTENDED, BusName
from .sockets import FrameSocket, Message, frame_socket

MAX_READ_FRAMES = 4096  # Frames of one read; those queued beyond come with the next

IP_MULTICAST_ALL = (socket.IPPROTO_IP, 49)
IPV6_MULTICAST_ALL = (socket.IPPROTO_IPV6, 29)
"""Socket options of Linux (linux/in.h, linux/in6.h), which Python does not name."""

SO_MEMINFO, MEMINFO = 55, struct.Struct("=9I")
"""Socket option of Linux with counters, the last of them the packets that did not fit into the socket's buffer."""

LOSS_PERIOD_S = 2.0  # Seconds between two looks at the frames that the socket lost

RECONNECT_WAITS_S = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Seconds before each attempt to open a bus again; the last one repeats."""


def open_bus(interface: str, channel: str | int, options: Mapping[str, object], filters: list | None = None) -> BusABC:
    """Open a bus through python-can.

    Raises:
        SourceError: If it cannot be opened.
    """
    options = dict(options)
    if interface == "udp_multicast":
        # Frames must not leave this machine unless the user asks for it: with 0 hops the kernel keeps them here.
        options.setdefault("hop_limit", 0)
    if filters is not None:
        options.setdefault("can_filters", filters)
    try:
        bus = can.Bus(channel=channel, interface=interface, **options)
        if interface == "udp_multicast" and sys.platform == "linux":
            _keep_own_group(bus)
        return bus
    except Exception as error:  # noqa: BLE001  drivers raise anything: OSError, ValueError, ImportError, their own
        raise SourceError(
            f"CAN bus {interface}:{channel}: it cannot be opened ({gist(error)}); check interface, channel and options"
        ) from None


def _keep_own_group(bus: BusABC) -> None:
    """Restrict a multicast bus to the frames of its own group.

    python-can binds its socket to the port alone. Linux then delivers the frames of every group that any process of the
    host has joined on that port, so that two channels would be one bus.
    """
    with socket.socket(fileno=os.dup(bus.fileno())) as sock:
        sock.setsockopt(*(IPV6_MULTICAST_ALL if sock.family == socket.AF_INET6 else IP_MULTICAST_ALL), 0)
        with suppress(BlockingIOError):
            while True:  # Frames of other groups may have arrived since the socket was bound.
                sock.recv(1, socket.MSG_DONTWAIT)


class CanBus:
    """Live source: decodes the frames of a bus that the channels need. A bus that fails is opened again, until `close`.

    Args:
        interface: Interface of python-can: virtual, udp_multicast, socketcan, ...
        channel: Channel of the interface.
        decoder: Decoder of the frames; its ids are the bus's filters.
        bus_options: Further arguments of the interface.
        report: Receives error frames, failures and reconnections of the bus, and messages that are never received.
        connect: Opens the bus, for tests.
        clock: Seconds, for the waits between attempts, for tests.

    Raises:
        SourceError: If the bus cannot be opened the first time.
    """

    live = True

    def __init__(
        self,
        interface: str,
        channel: str | int,
        decoder: Decoder,
        *,
        bus_options: Mapping[str, object] | None = None,
        report: Report = ignore,
        connect: Callable[[], BusABC] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name = f"{interface}:{channel}"
        self._interface = interface
        self._decoder = decoder
        self._report = report
        self._clock = clock
        # The kernel filters for SocketCAN; python-can would for multicast, and hide how many frames were received.
        filters = None if interface == "udp_multicast" else decoder.filters
        self._connect = connect or (lambda: open_bus(interface, channel, bus_options or {}, filters))
        self._closed = threading.Event()
        self._attempts = 0
        self._next_attempt = 0.0
        self._failed_before = False
        self._bus: BusABC | None = None
        self._socket: FrameSocket | None = None
        self._open()
        self._monitor = MessageMonitor(f"CAN bus {self._name}", decoder, clock, report)
        self._loss = SocketLoss(f"CAN bus {self._name}", clock, report)

    def read(self, timeout: float) -> Events | None:
        """Return the events of the queued frames; wait up to `timeout` seconds for the first. None once closed."""
        if self._closed.is_set():
            return None
        if self._bus is None and not self._reconnect(timeout):
            return Events.empty(self._decoder.width)
        messages: list[Message] = []
        arrivals: list[int] = []
        try:
            for message in islice(self._frames(timeout), MAX_READ_FRAMES):
                messages.append(message)
                arrivals.append(time.time_ns())
            self._failed_before = False
        except Exception as error:  # noqa: BLE001  drivers raise anything; the twin continues
            self._failed(error)
        for message in messages:
            if message.is_error_frame:
                self._report("error frame", f"CAN bus {self._name}: error frame")
        frames = self._decoder.gather(messages, arrivals)
        batch = self._decoder.decode(frames) if frames.plan.size else Events.empty(self._decoder.width)
        self._monitor.note(messages)
        self._loss.note(self._bus, len(messages))
        return batch

    def _open(self) -> None:
        self._bus = self._connect()
        self._socket = frame_socket(self._interface, self._bus)

    def _frames(self, timeout: float) -> Iterator[Message]:
        """Return the queued frames; wait up to `timeout` seconds for the first."""
        if self._socket is not None:
            yield from self._socket.frames(timeout)
            return
        bus: BusABC = self._bus
        while (message := bus.recv(timeout)) is not None:
            yield message
            timeout = 0

    def _failed(self, error: Exception) -> None:
        """Report an error. One may be a bad packet; after two in a row the bus is opened again."""
        self._report("bus error", f"CAN bus {self._name}: {gist(error)}")
        if not self._failed_before:
            self._failed_before = True
            return
        self._shut()
        self._attempts = 0
        self._next_attempt = self._clock() + RECONNECT_WAITS_S[0]

    def _reconnect(self, timeout: float) -> bool:
        """Try to open the bus when its time has come; wait no longer than `timeout`."""
        wait = self._next_attempt - self._clock()
        if wait > 0:
            self._closed.wait(min(wait, timeout))
            if self._closed.is_set() or self._next_attempt > self._clock():
                return False
        try:
            self._open()
        except SourceError as error:
            self._attempts += 1
            wait = RECONNECT_WAITS_S[min(self._attempts, len(RECONNECT_WAITS_S) - 1)]
            self._next_attempt = self._clock() + wait
            self._report("bus error", f"{error}; next attempt in {wait:g} s")
            return False
        self._failed_before = False
        self._report("bus reconnected", f"CAN bus {self._name}: open again")
        return True

    def _shut(self) -> None:
        bus, frames, self._bus, self._socket = self._bus, self._socket, None, None
        if frames is not None:
            frames.close()
        if bus is not None:
            try:
                bus.shutdown()
            except Exception as error:  # noqa: BLE001  a failed driver may not close
                self._report("bus error", f"CAN bus {self._name}: it did not close ({error})")

    def now(self) -> int:
        """Return the wall-clock time, ns."""
        return time.time_ns()

    def close(self) -> None:
        """Close the bus."""
        self._closed.set()
        self._shut()


def dropped_frames(bus: BusABC) -> int | None:
    """Return the frames that the bus's socket has lost since it was opened, as its buffer was full; None if unknown.

    The kernel's counter is read as an option of the socket: with SO_RXQ_OVFL it would come with each frame, and
    python-can (4.6) refuses frames with more than its own time stamp.
    """
    try:
        with socket.socket(fileno=os.dup(bus.fileno())) as sock:
            return int(MEMINFO.unpack(sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size))[-1])
    except (AttributeError, NotImplementedError, OSError, TypeError, struct.error):
        return None  # A bus without a socket, or no Linux


class SocketLoss:
    """Reports frames that the socket of a bus lost: this process reads too slowly, and no sensor is to blame."""

    def __init__(self, name: str, clock: Callable[[], float], report: Report) -> None:
        """Start now; `name` begins each line, `clock` gives seconds."""
        self._name, self._clock, self._report = name, clock, report
        self._bus: BusABC | None = None
        self._received, self._before, self._total, self._next = 0, 0, 0, 0.0

    def note(self, bus: BusABC | None, received: int) -> None:
        """Count frames received from a bus, and look at those it lost when their time has come."""
        now = self._clock()
        if bus is not self._bus:
            self._bus, self._received, self._before, self._next = bus, 0, 0, now + LOSS_PERIOD_S
        self._received += received
        if now < self._next or bus is None:
            return
        count, self._next = dropped_frames(bus), now + LOSS_PERIOD_S
        # The kernel counts in 32 bits.
        lost = 0 if count is None else (count - self._before) % 2**32
        if lost:
            self._total += lost
            share = 100.0 * lost / (lost + self._received)
            self._report(
                LOST_FRAMES,
                f"{self._name}: {share:.2g} % of frames dropped by the socket ({lost:,} of {lost + self._received:,}; "
                f"{self._total:,} in all): they arrive faster than this process reads them; raise the receive buffer "
                "(sysctl net.core.rmem_default), or reduce the load of this machine or bus",
            )
        self._before, self._received = count or 0, 0


MISSING_AFTER_S = 5.0
MISSING_PERIODS = 3.0
"""Seconds, or periods of the message if they are longer, after which a message is reported as never received."""

MIN_MULTIPLEXED_FRAMES = 20
"""Frames of a message after which a signal is reported as missing, since a multiplexer may send it rarely."""


class MessageMonitor:
    """Reports once each message that the decoder needs and the bus does not carry."""

    def __init__(self, name: str, decoder: Decoder, clock: Callable[[], float], report: Report) -> None:
        """Start now; `name` begins each line, `clock` gives seconds."""
        self._name, self._decoder, self._clock, self._report = name, decoder, clock, report
        self._seen: Counter[tuple[BusName, int]] = Counter()
        self._since = self._next = clock()
        self._reported: set[MessageIds] = set()
        self._silence_reported = False
        self._done = False

    def note(self, messages: Iterable[Message]) -> None:
        """Count the messages since the last call, which may be none."""
        if self._done:
            return
        now = self._clock()
        for message in messages:
            if not message.is_error_frame and not message.is_remote_frame:
                if not self._seen:
                    # The bus has been silent until now: the time of each message starts here.
                    self._since = now
                key = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
                self._seen[message.channel, key] += 1
        waited = now - self._since
        if waited >= MISSING_AFTER_S and now >= self._next:
            self._next = now + 1.0
            self._check(waited)

    def _check(self, waited: float) -> None:
        waiting = [item for item in self._decoder.expected if item.ids not in self._reported]
        if not self._seen:
            if not self._silence_reported:
                self._silence_reported = True
                named = ", ".join(f"{item.name} ({item.ids})" for item in waiting[:4])
                more = ", ..." if len(waiting) > 4 else ""
                self._report(
                    NEVER,
                    f"{self._name}: none of {named}{more} was received in {MISSING_AFTER_S:g} s; check interface, "
                    "channel and bit rate, and the ids in the DBC",
                )
            return
        for item in waiting:
            texts = self._decoder.missing(item, self._seen, least=MIN_MULTIPLEXED_FRAMES)
            if not texts or waited < MISSING_PERIODS * item.period:
                continue
            self._reported.add(item.ids)
            for text in texts:
                self._report(NEVER, f"{self._name}: after {waited:.0f} s {text}")
        self._done = all(item.ids in self._reported for item in waiting)
