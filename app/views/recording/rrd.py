"""An .rrd that this program writes itself: whole messages only, whatever the disk does.

Rerun's own file sink keeps an entry of each column of each chunk in memory for the footer, some kilobytes a chunk for
as long as it records; it opens whatever stands under the name, through links too; and it waits without end for a disk
that takes no more. So the bytes are taken from the stream and written here. Without a footer a viewer reads the file
from its start, as it does with one whose writer was killed.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import rerun as rr

STREAM_HEADER, MESSAGE_HEADER = 12, struct.Struct("<QQ")
"""Bytes before the first message of an .rrd; and before each: its kind, and how many bytes follow."""

END = 0
"""The kind of the message that closes a stream."""

BEGIN = b"RRF2"
"""What an .rrd begins with."""

PATIENCE = 5.0
"""Seconds for Rerun to hand over what was logged."""


class RrdFile:
    """Writes what a stream logs into a new file."""

    def __init__(self, path: Path, stream: rr.RecordingStream) -> None:
        """Make the file, under a name that nothing stands under yet: not even a link that leads nowhere.

        Raises:
            OSError: If it cannot be made, or the name is taken.
        """
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        self._stream = stream
        self._bytes = stream.binary_stream()
        self.size = 0

    def flush(self) -> None:
        """Hand to the operating system what was logged since.

        Raises:
            OSError: If the file takes no more; it then ends where it ended before.
        """
        data = self._bytes.read(flush_timeout_sec=PATIENCE)
        if not data:
            return
        # Each piece is a stream of its own, with a header and a footer that hold for the first and for none.
        end = next((at for at, kind, _ in messages(data) if kind == END), len(data))
        self._write(data[STREAM_HEADER if self.size else 0 : end])

    def close(self) -> None:
        """Write what is left and the end; the file is closed also if it does not take them.

        Raises:
            OSError: As `flush`.
        """
        try:
            self.flush()
            self._write(MESSAGE_HEADER.pack(END, 0))
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Let go of the file as it is."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self._stream.disconnect()

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._file, self.size)
                os.lseek(self._file, self.size, os.SEEK_SET)
            raise
        self.size += len(data)


def messages(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Where each message of an .rrd's bytes begins, its kind, and where it ends; those that are there in full."""
    at = STREAM_HEADER
    while at + MESSAGE_HEADER.size <= len(data):
        kind, length = MESSAGE_HEADER.unpack_from(data, at)
        end = at + MESSAGE_HEADER.size + length
        if end > len(data):
            return
        yield at, kind, end
        at = end


def whole_until(file: BinaryIO, size: int) -> tuple[int, bool]:
    """Where the last message that is there in full ends, in a file of `size` bytes; and whether it closes the file."""
    end, kind = STREAM_HEADER, -1
    while kind != END and end + MESSAGE_HEADER.size <= size:
        file.seek(end)
        kind_here, length = MESSAGE_HEADER.unpack(file.read(MESSAGE_HEADER.size))
        if end + MESSAGE_HEADER.size + length > size:
            break
        kind, end = kind_here, end + MESSAGE_HEADER.size + length
    return min(end, size), kind == END
