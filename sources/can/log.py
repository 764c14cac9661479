"""Recorded CAN logs: BLF, ASC, TRC, candump, CSV and SQLite through python-can, MF4 through asammdf."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache
from pathlib import Path

import can

from estimators.errors import SourceError
from estimators.log import Events

from ..archives import archive_of, is_compressed
from ..formats import CAN_LOGS, EITHER, check_present, suffix_of
from ..source import NEVER, TRUNCATED, Recorded, Report, ignore
from ..units import second_ns
from ..worker_process import IsolatedReader, read_isolated
from . import check_mf4
from .decoder import Decoder, SendersError
from .mf4 import mf4_span, read_mf4
from .readers import BusName, LogSummary, Raw, open_reader, read_messages, unreadable


class CanLog(Recorded):
    """Source of recorded CAN logs: files read one after the other, as one log.

    Args:
        files: Recordings in their order.
        decoder: Decoder of their frames.
        report: Receives error frames, damaged files, and at the end messages that were never received.
        refuse: Whether a message of several senders is an error, once the second one is read; else it is left out.
        zone: Time zone of the dates of text logs; None is UTC.

    Raises:
        SourceError: If a file is missing, empty, or of no known format.
    """

    def __init__(
        self,
        files: Sequence[str | os.PathLike[str]],
        decoder: Decoder,
        *,
        report: Report = ignore,
        refuse: bool = True,
        zone: str | None = None,
    ) -> None:
        self._files = [Path(file) for file in files]
        if not self._files:
            raise SourceError("CAN log: files is empty; name at least one recording")
        self._decoder = decoder
        self._report, self._zone = report, zone
        decoder.refuse = refuse
        for path in self._files:
            check_log(path)
        more = f" and {len(self._files) - 1} more" if len(self._files) > 1 else ""
        self._name = f"{self._files[0].name}{more}"
        self.frames = 0
        """Frames read so far, wanted or not."""
        self._seen: Counter[tuple[BusName, int]] = Counter()
        self._batches = self._all()

    @cached_property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns; None if the format does not store them."""
        first, last = _span(self._files[0]), _span(self._files[-1])
        return None if first is None or last is None or last[1] < first[0] else (first[0], last[1])

    def _all(self) -> Generator[Events, None, None]:
        for path in self._files:
            yield from self._one(path)
        for item in self._decoder.expected:
            for text in self._decoder.missing(item, self._seen):
                self._report(NEVER, f"{self._name}: {text}")

    def _one(self, path: Path) -> Generator[Events, None, None]:
        before = self.frames
        reader = frames_reader(path, self._decoder.wanted, self._decoder.longest, self._zone)
        fault = ""
        try:
            while not reader.ended:
                item = reader.get(self._timeout)
                if isinstance(item, Raw):
                    self.frames += item.total
                    batch = self._decoder.decode(self._decoder.frames_of(item))
                    if len(batch):
                        yield batch
                elif isinstance(item, LogSummary):
                    self._seen.update(item.seen)
                    for _ in range(item.errors):
                        self._report("error frame", f"{path.name}: error frame")
                    fault = item.fault
                elif not reader.ended:
                    yield Events.empty(self._decoder.width)
        except SendersError as error:
            raise SourceError(f"{path}: {error}") from None
        except SourceError as error:
            if self.frames == before and path == self._files[0]:
                # An error of the reader names the file; one of its process does not.
                raise error if str(path) in str(error) else unreadable(path, error) from None
            fault = str(error).removeprefix(f"{path}: ")
        finally:
            reader.close()
        count = self.frames - before
        if fault or not count:
            fault = fault or "it holds none"
            self._report(TRUNCATED, f"{path.name}: the file is damaged ({fault}); {count} frames were read")


def frames_reader(path: Path, wanted: frozenset[int] | None, longest: int, zone: str | None) -> IsolatedReader:
    """Return the frames of a log, read in a process of its own; arguments as those of `read_messages`."""
    if suffix_of(path) == ".mf4":
        return IsolatedReader(read_mf4, path, wanted, longest)
    return IsolatedReader(read_messages, path, wanted, longest, *(() if zone is None else (zone,)))


def check_log(path: Path) -> None:
    """Refuse a file that cannot be read.

    Raises:
        SourceError: If the file is missing, empty, or of no known format, or the package that reads it is missing.
    """
    check_present(path)
    known, archive = suffix_of(path) in (*CAN_LOGS, *EITHER), archive_of(path)
    if known and (archive or (is_compressed(path) and path.suffix.lower() != ".gz")):
        text = f"is a CAN log, of which only .gz is unpacked; unpack {(archive or path).name}, and name the logs"
        raise SourceError(f"{path}: {text}")
    if not known:
        raise SourceError(
            f"{path}: {path.suffix or 'a bare name'} is not a CAN log format; choose from {', '.join(CAN_LOGS)}"
        )
    if suffix_of(path) == ".mf4":
        with path.open("rb") as file:
            if file.read(3) not in (b"MDF", b"UnF"):
                raise SourceError(f"{path}: it cannot be read as MF4; check that it is one")
        check_mf4(path)
        return
    open_reader(path).stop()


SPAN_TIMEOUT_S = 5.0  # Seconds to wait for the span, which only draws a slider
TAIL_BYTES = 4096  # Bytes at the end of a text log that hold its last lines


def _span(path: Path) -> tuple[int, int] | None:
    kind = path.suffix.lower()
    with suppress(OSError, ValueError, SourceError):  # Errors are reported when the file is read.
        if kind == ".mf4":
            stat = path.stat()
            return _mf4(path, stat.st_mtime_ns, stat.st_size)
        if kind == ".blf":
            with can.BLFReader(path) as reader:
                span = second_ns(reader.start_timestamp), second_ns(reader.stop_timestamp)
            # A logger that lost power has not written the end.
            return span if span[1] > span[0] > 0 else None
        if kind == ".log":
            return _candump(path)
    return None


@lru_cache(maxsize=64)
def _mf4(path: Path, stamp: int, size: int) -> tuple[int, int] | None:
    """Return the span of an MF4 file, cached while it is unchanged: a replay reads it again after each seek back."""
    return next(iter(read_isolated(mf4_span, path, timeout=SPAN_TIMEOUT_S)), None)


def _candump(path: Path) -> tuple[int, int] | None:
    with path.open("rb") as file:
        head = file.read(TAIL_BYTES)
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        found = re.findall(rb"(?m)^\((\d+\.\d+)\) ", head + b"\n" + file.read())
    return (second_ns(float(found[0])), second_ns(float(found[-1]))) if found else None
