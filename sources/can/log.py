"""Recorded CAN logs: BLF, ASC, TRC, candump, CSV and SQLite through python-can, MF4 through asammdf."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Generator, Sequence
from functools import cached_property
from pathlib import Path

from estimators.errors import SourceError
from estimators.log import Events

from ..formats import CAN_LOGS, is_compressed, suffix_of
from ..reader_process import IsolatedReader
from ..source import NEVER, TRUNCATED, Report, ignore
from .decoder import Decoder
from .frames import BusName, Found, Raw, unreadable
from .readers import open_reader, read_frames
from .span import log_span


class CanLog:
    """Reads log files one after the other, as one log.

    Args:
        files: Recordings in their order.
        decoder: What to take from their frames.
        report: Told of error frames, of files that are damaged, and at the end of messages that were never seen.

    Raises:
        SourceError: If a file is missing, empty, or of no known format.
    """

    live = False

    def __init__(self, files: Sequence[str | os.PathLike[str]], decoder: Decoder, *, report: Report = ignore) -> None:
        self._files = [Path(file) for file in files]
        if not self._files:
            raise SourceError("CAN log: files is empty; name at least one recording")
        self._decoder = decoder
        self._report = report
        for path in self._files:
            check_log(path)
        more = f" and {len(self._files) - 1} more" if len(self._files) > 1 else ""
        self._name = f"{self._files[0].name}{more}"
        self.frames = 0
        """Frames read so far, wanted or not."""
        self._seen: Counter[tuple[BusName, int]] = Counter()
        self._timeout = 0.0
        self._batches = self._all()

    @cached_property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns; None where the format does not tell without being read."""
        return log_span(self._files)

    def _all(self) -> Generator[Events, None, None]:
        for path in self._files:
            yield from self._one(path)
        for item in self._decoder.expected:
            for text in self._decoder.missing(item, self._seen):
                self._report(NEVER, f"{self._name}: {text}")

    def _one(self, path: Path) -> Generator[Events, None, None]:
        before = self.frames
        reader = IsolatedReader(read_frames, path, self._decoder.wanted, self._decoder.longest)
        fault = ""
        try:
            while not reader.ended:
                item = reader.take(self._timeout)
                if isinstance(item, Raw):
                    self.frames += item.total
                    batch = self._decoder.decode(self._decoder.frames_of(item))
                    if len(batch):
                        yield batch
                elif isinstance(item, Found):
                    self._seen.update(item.seen)
                    for _ in range(item.errors):
                        self._report("error frame", f"{path.name}: error frame")
                    fault = item.fault
                elif not reader.ended:
                    yield Events.empty(self._decoder.width)
        except SourceError as error:
            if self.frames == before and path == self._files[0]:
                # What the reader itself raised names the file; what became of the reader does not.
                raise error if str(path) in str(error) else unreadable(path, error) from None
            fault = str(error).removeprefix(f"{path}: ")
        finally:
            reader.close()
        count = self.frames - before
        if fault or not count:
            fault = fault or "it holds none"
            self._report(TRUNCATED, f"{path.name}: the file is damaged after {count} frames ({fault})")

    def read(self, timeout: float) -> Events | None:
        """The events of the next frames; none if there are none within `timeout` seconds; None at the end."""
        self._timeout = timeout
        return next(self._batches, None)

    def now(self) -> int | None:
        """A recording has no clock."""
        return None

    def close(self) -> None:
        """Close the file that is open."""
        self._batches.close()


def check_log(path: Path) -> None:
    """Refuse at once what could not be read later.

    Raises:
        SourceError: If the file is missing, empty, or of no known format.
    """
    if not path.is_file():
        raise SourceError(f"{path}: there is no such file; check the path of the recording")
    if path.stat().st_size == 0:
        raise SourceError(f"{path}: the file is empty; record it again")
    if suffix_of(path) not in CAN_LOGS or (is_compressed(path) and path.suffix.lower() != ".gz"):
        raise SourceError(
            f"{path}: {path.suffix or 'a bare name'} is not a CAN log format; choose from {', '.join(CAN_LOGS)}"
        )
    if suffix_of(path) == ".mf4":
        with path.open("rb") as file:
            if file.read(3) not in (b"MDF", b"UnF"):
                raise SourceError(f"{path}: it cannot be read as MF4; check that it is one")
        return
    open_reader(path).stop()
