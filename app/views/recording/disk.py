"""Room on a disk: a warning before it is full, and the moment to end while a file can still be closed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

RESERVE = 32 * 2**20
"""Free bytes at which a recording ends: what closes it still fits, and others find room."""

LOW = 1e9
"""Free bytes below which there is a warning, however slowly the file grows."""

AHEAD = 900.0
"""Seconds: a file that would fill the disk sooner, at the rate at which it has grown so far, is warned of."""

SETTLED = 60.0
"""Seconds of growth after which that rate says something: a long history is written at once."""


class Disk:
    """Watches the room that a growing file has left."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder = folder
        self._clock = clock
        self._begun: tuple[float, int] | None = None
        self._warned = False

    def free(self) -> int:
        """Bytes that a file may still take before it has to end; less than 0 when it is time."""
        return shutil.disk_usage(self._folder).free - RESERVE

    def warning(self, size: int) -> str | None:
        """One line, once, when the room will soon be used up by a file that has `size` bytes now."""
        now = self._clock()
        if self._begun is None:
            self._begun = (now, size)
        if self._warned:
            return None
        since, before = self._begun
        left = self.free()
        rate = (size - before) / (now - since) if now - since >= SETTLED else 0.0
        if left > LOW and (rate <= 0.0 or left / rate > AHEAD):
            return None
        self._warned = True
        lasts = f", which lasts for about {left / rate / 60:.0f} min" if rate > 0.0 else ""
        return f"the disk of {self._folder.resolve()} has room for {left / 1e6:.0f} MB more{lasts}; make room, or stop"
