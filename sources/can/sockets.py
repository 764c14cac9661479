"""Frames straight from the socket of a SocketCAN or UDP multicast bus of python-can, as many as are queued.

python-can waits for, filters, logs and checks each frame in Python. Here a frame costs one call of the kernel. Times
and content are those of python-can's message, whose own functions read any packet that is not plain.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

import can
import msgpack

from .readers import BusName

CMSG_TIME = struct.Struct("@ll")
TIME_SPACE = socket.CMSG_SPACE(CMSG_TIME.size) if hasattr(socket, "CMSG_SPACE") else 0
"""Seconds and nanoseconds of the kernel's time stamp, and the room that they need."""

MAX_PACKET_BYTES = 4096

CAN_HEADER = struct.Struct("=IB")
"""Identifier with flags, and length; the data follow at byte 8 (linux/can.h)."""

EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x80000000, 0x40000000, 0x20000000
FD_LENGTHS = tuple(min(length for length in can.util.CAN_FD_DLC if length >= n) for n in range(65))

PACKET_KEYS = frozenset(
    (
        "timestamp", "arbitration_id", "is_extended_id", "is_remote_frame", "is_error_frame", "channel", "dlc", "data",
        "is_fd", "bitrate_switch", "error_state_indicator",
    )
)  # fmt: skip
"""Fields of a frame of python-can's UDP multicast."""


class Frame(NamedTuple):
    """The fields of python-can's message that decoding needs."""

    timestamp: float
    arbitration_id: int
    is_extended_id: bool
    is_remote_frame: bool
    is_error_frame: bool
    channel: BusName
    data: bytes


Message: TypeAlias = "Frame | can.Message"
Parse = Callable[[bytes, float, str | tuple[str, ...]], "Message | None"]
"""Return the frame of a packet, its time and its sender's address; None for one that the bus does not deliver."""


def socketcan_parser(bus: can.BusABC) -> Parse:
    """Return the parser of `struct can_frame` and `struct canfd_frame`."""
    own = bus.channel

    def parse(packet: bytes, timestamp: float, address: str | tuple[str, ...]) -> Frame:
        identifier, length = CAN_HEADER.unpack_from(packet)
        extended, remote = bool(identifier & EXTENDED_FLAG), bool(identifier & REMOTE_FLAG)
        return Frame(
            timestamp,
            identifier & (0x1FFFFFFF if extended else 0x7FF),
            extended,
            remote,
            bool(identifier & ERROR_FLAG),
            own or (address[0] if isinstance(address, tuple) else address),
            b"" if remote else packet[8 : 8 + FD_LENGTHS[length]],
        )

    return parse


def multicast_parser(bus: can.BusABC) -> Parse:
    """Return the parser of the packets of python-can's UDP multicast."""
    from can.interfaces.udp_multicast.utils import unpack_message

    unpack, fd = msgpack.unpackb, bus.protocol is can.CanProtocol.CAN_FD

    def parse(packet: bytes, timestamp: float, _address: object) -> Message | None:
        try:
            found = unpack(packet, raw=False)
            key, extended, data, channel = (
                found["arbitration_id"], found["is_extended_id"], found["data"], found["channel"],
            )  # fmt: skip
            if (
                type(data) is bytes
                and len(data) == found["dlc"] <= 8
                and type(key) is int
                and 0 <= key < (0x20000000 if extended else 0x800)
                and not found["is_remote_frame"]
                and not found["is_error_frame"]
                and not found["is_fd"]
                and not found["bitrate_switch"]
                and not found["error_state_indicator"]
                and found.keys() == PACKET_KEYS
                and (channel is None or type(channel) in (str, int))
            ):
                return Frame(timestamp, key, bool(extended), False, False, channel, data)
            message = unpack_message(packet, replace={"timestamp": timestamp}, check=True)
            hash((message.channel, message.arbitration_id | 0))  # The decoder and the counts take it as a key
        except Exception:  # noqa: BLE001  the sender may be anybody
            raise can.CanOperationError("could not unpack received message") from None
        return message if fd or not message.is_fd else None

    return parse


PARSERS = {"socketcan": socketcan_parser, "udp_multicast": multicast_parser}


class FrameSocket:
    """The socket of an open bus, for reading all frames that it has queued."""

    def __init__(self, bus: can.BusABC, parse: Parse) -> None:
        """Read the socket of `bus` beside it; both are to be closed."""
        self._parse = parse
        self._socket = socket.socket(fileno=os.dup(bus.fileno()))
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)

    def frames(self, timeout: float) -> Iterator[Message]:
        """Yield the queued frames until there are no more; wait up to `timeout` seconds for the first.

        Raises:
            OSError: If the bus is gone.
            can.CanOperationError: If a packet is no frame.
        """
        receive, parse, unpack = self._socket.recvmsg, self._parse, CMSG_TIME.unpack
        while True:
            try:
                packet, ((_, _, stamp),), _, address = receive(MAX_PACKET_BYTES, TIME_SPACE, socket.MSG_DONTWAIT)
            except BlockingIOError:
                if timeout and self._poll.poll(1000.0 * timeout):
                    timeout = 0.0
                    continue
                return
            timeout = 0.0
            seconds, nanoseconds = unpack(stamp)
            frame = parse(packet, seconds + nanoseconds * 1e-9, address)
            if frame is not None:
                yield frame

    def close(self) -> None:
        """Close this end of the socket."""
        self._socket.close()


def frame_socket(interface: str, bus: can.BusABC) -> FrameSocket | None:
    """Return the socket of a bus; None if its frames come through python-can alone: no Linux, or filters in Python."""
    if sys.platform != "linux" or interface not in PARSERS or (bus.filters and not getattr(bus, "_is_filtered", False)):
        return None
    return FrameSocket(bus, PARSERS[interface](bus))
