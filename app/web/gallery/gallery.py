"""Who changes what runs: one start at a time, in a thread of its own, while what ran before goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from config.loader import shipped
from estimators.errors import ConfigError, NisusError, nearest, quoted

from ...twin.twin import Twin
from ..running import Opening
from ..session import Session


@dataclass(frozen=True)
class Wanted:
    """What is to run: a twin, perhaps on other recordings than its own, or a recording to review."""

    twin: str | None = None
    logs: tuple[Path, ...] = ()
    recording: Path | None = None

    @property
    def name(self) -> str:
        """What people call it."""
        if self.recording is not None:
            return self.recording.name
        name = Path(self.twin or "").stem
        return f"{name} on {', '.join(log.name for log in self.logs)}" if self.logs else name


@dataclass(frozen=True)
class Failed:
    """What could not be started, and why, in one line."""

    name: str
    text: str


class Opener(Protocol):
    """How what is wanted is read from its files, and made ready."""

    def open(self, wanted: Wanted) -> Opening:
        """Read it.

        Raises:
            NisusError: If a file is absent or wrong.
        """

    def made_ready(self, opening: Opening) -> Opening:
        """Compile its model, and begin to compile its filters.

        Raises:
            NisusError: If that fails.
        """

    def prepare(self, twin: Twin) -> None:
        """Compile the model and the filter of a twin whose files were saved anew.

        Raises:
            NisusError: If that fails.
        """


class Gallery:
    """Starts, switches and stops what runs in a session."""

    def __init__(self, session: Session, opener: Opener, *, first: Wanted | None = None, own: Sequence[str] = ()):
        """Take over a session.

        Args:
            session: Whose page shows what runs.
            opener: Reads what is wanted.
            first: What runs at first.
            own: Paths of twins beside those that ship; nothing else may be started, as a twin's model is a program.
        """
        self.session = session
        self.own = tuple(own)
        self.running: Wanted | None = first
        self.starting: tuple[Wanted, float] | None = None
        self.compiling: float | None = None
        """Since when what is being started is made ready; None while it is not."""
        self.failed: Failed | None = None
        self._opener = opener
        self._lock = threading.Lock()

    def names(self) -> list[str]:
        """Of all twins that may be started."""
        return [*self.own, *shipped()]

    def start(self, wanted: Wanted) -> None:
        """Begin to start something; `starting` and `failed` say how it goes.

        Raises:
            ConfigError: If there is no such twin, or something is being started already.
        """
        if wanted.twin is not None and wanted.twin not in self.names():
            raise ConfigError(f"{quoted(wanted.twin)} is no twin of this gallery; {nearest(wanted.twin, self.names())}")
        self._begin(wanted, lambda: self._start(wanted))

    def again(self, remark: str) -> None:
        """Begin to start anew what runs, which says why.

        Raises:
            ConfigError: If something is being started already, or nothing runs.
        """
        wanted = self.running
        if wanted is None:
            raise ConfigError("nothing runs that could be started anew")
        self._begin(wanted, lambda: self._start(wanted, remark))

    def prepare(self, twin: Twin) -> None:
        """Compile what a twin runs with; raises as `Opener.prepare`."""
        self._opener.prepare(twin)

    def stop(self) -> None:
        """Stop what runs; the gallery stays."""
        with self._lock:
            self.running = None
        self.session.change(None)

    def _begin(self, wanted: Wanted, work: Callable[[], None]) -> None:
        with self._lock:
            if self.starting is not None:
                raise ConfigError(f"{self.starting[0].name} is being started; wait until it runs")
            self.starting, self.failed = (wanted, time.monotonic()), None
        threading.Thread(target=self._carry_out, args=(wanted, work), name="gallery", daemon=True).start()

    def _carry_out(self, wanted: Wanted, work: Callable[[], None]) -> None:
        failed = None
        try:
            work()
        except NisusError as error:
            failed = Failed(wanted.name, str(error).splitlines()[0])
        except Exception as error:  # noqa: BLE001  a driver or a user's model may raise anything
            failed = Failed(wanted.name, f"{type(error).__name__}: {error}")
        with self._lock:
            self.starting, self.failed = None, failed
            if self.session.running is None:
                self.running = None

    def _start(self, wanted: Wanted, remark: str | None = None) -> None:
        opening = self._opener.open(wanted)
        if remark is not None:
            opening = replace(opening, remarks=[*opening.remarks, ("warn", remark)])
        self.compiling = time.monotonic()
        try:
            opening = self._opener.made_ready(opening)
        finally:
            self.compiling = None
        self._put(wanted, opening)

    def _put(self, wanted: Wanted, opening: Opening) -> None:
        """Run it in place of what runs."""
        # Two on one bus would hear each other's asset.
        both = _on_a_bus(opening) and self._runs_on_a_bus()
        try:
            self.session.change(lambda: self.session.prepared(opening), stop_first=both)
        except BaseException:
            if opening.workshop is not None:
                opening.workshop.stop()
            raise
        self.running = wanted

    def _runs_on_a_bus(self) -> bool:
        ran = self.session.running
        return ran is not None and _on_a_bus(ran.opening)


def _on_a_bus(opening: Opening) -> bool:
    return opening.review is None and opening.twin.config.source.type == "can" and opening.twin.plan.log_files is None
