"""Start, switch and stop the twin of a session: one start at a time, while the running twin goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from config.loader import shipped, shown_path
from config.tunings import OWN_VALUES
from estimators.errors import ConfigError, NisusError, nearest, quoted, reason_of

from ...engine.jobs import Job
from ...twin.changes import obstacle
from ...twin.twin import VERSION, Twin, with_version
from ..running import OpenedTwin, RunningTwin, stamp_of
from ..session import Session


@dataclass(frozen=True)
class StartRequest:
    """A twin to run, perhaps on other logs than its own, or a recording to review."""

    twin: str | None = None
    logs: tuple[Path, ...] = ()
    recording: Path | None = None

    @property
    def name(self) -> str:
        """Name for messages."""
        if self.recording is not None:
            return self.recording.name
        name = Path(self.twin or "").stem
        return f"{name} on {', '.join(log.name for log in self.logs)}" if self.logs else name


class Opener(Protocol):
    """Reads a requested twin from its files, and compiles it."""

    def open(self, wanted: StartRequest) -> OpenedTwin:
        """Read it.

        Raises:
            NisusError: If a file is absent or wrong.
        """

    def made_ready(self, opening: OpenedTwin) -> OpenedTwin:
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
    """Starts, switches and stops the twin of a session."""

    def __init__(self, session: Session, opener: Opener, *, first: StartRequest | None = None, own: Sequence[str] = ()):
        """Take over a session, whose page shows the running twin; `opener` reads requested ones, `first` runs at first.

        `own` has paths of twins beside those that ship; nothing else may be started, as a twin's model is a program.
        """
        self.session = session
        self.own = tuple(own)
        self.running: StartRequest | None = first
        self.starting: tuple[StartRequest, float] | None = None
        self.compiling: float | None = None
        """Start of the compilation under way, s; None without one."""
        self.failed: tuple[StartRequest, str] | None = None
        """The last start that failed, and the reason in one line."""
        self.opener = opener
        self._lock = threading.Lock()

    def names(self) -> list[str]:
        """Return the names of all twins that may be started."""
        return [*self.own, *shipped()]

    def start(self, wanted: StartRequest) -> None:
        """Begin to start a twin; `starting` and `failed` show its progress.

        Raises:
            ConfigError: If there is no such twin, or something is being started already.
        """
        if wanted.twin is not None and wanted.twin not in self.names():
            raise ConfigError(f"{quoted(wanted.twin)} is no twin of this gallery; {nearest(wanted.twin, self.names())}")
        self._begin(wanted)

    def add(self, twin: str) -> None:
        """Add a twin that was drafted here to the user's own, and begin to start it.

        Raises:
            ConfigError: If something is being started already.
        """
        self.own = (twin, *(name for name in self.own if name != twin))
        self.start(StartRequest(twin))

    def again(self, remark: str) -> None:
        """Begin to start the running twin anew, with a notice of the reason.

        Raises:
            ConfigError: If something is being started already, or nothing runs.
        """
        wanted = self.running
        if wanted is None:
            raise ConfigError("nothing runs that could be started anew")
        self._begin(wanted, remark)

    def stop(self) -> None:
        """Stop the running twin; the gallery stays."""
        with self._lock:
            self.running = None
        self.session.change(None)

    def _begin(self, wanted: StartRequest, remark: str | None = None) -> None:
        with self._lock:
            if self.starting is not None:
                raise ConfigError(f"{self.starting[0].name} is being started; wait until it runs")
            self.starting, self.failed = (wanted, time.monotonic()), None
        threading.Thread(target=self._carry_out, args=(wanted, remark), name="gallery", daemon=True).start()

    def _carry_out(self, wanted: StartRequest, remark: str | None) -> None:
        failed = None
        try:
            self._start(wanted, remark)
        except Exception as error:  # noqa: BLE001  a driver or a user's model may raise anything
            failed = wanted, reason_of(error).splitlines()[0]
        with self._lock:
            self.starting, self.failed = None, failed
            if self.session.running is None:
                self.running = None

    def _start(self, wanted: StartRequest, remark: str | None) -> None:
        opening = self.opener.open(wanted)
        if remark is not None:
            opening = replace(opening, remarks=[*opening.remarks, ("warn", remark)])
        self.compiling = time.monotonic()
        try:
            opening = self.opener.made_ready(opening)
        finally:
            self.compiling = None
        running = self.session.running
        # Two twins on one bus would read each other's asset; and a store is of one process at a time.
        both = running is not None and (
            (_reads_a_bus(running.opening) and _reads_a_bus(opening)) or opening.store is not None
        )
        del running  # which is to be collected once it is replaced
        try:
            self.session.change(lambda: self.session.prepared(opening), stop_first=both)
        except BaseException:
            if opening.compile_queue is not None:
                opening.compile_queue.stop()
            raise
        self.running = wanted


def _reads_a_bus(opening: OpenedTwin) -> bool:
    return opening.review is None and opening.twin.config.source.type == "can" and opening.twin.plan.log_files is None


FILE_POLL_PERIOD_S = 0.4
"""Between two looks at the files. An editor may write in pieces: a file is read once it is unchanged."""


class SavedFiles:
    """Watches the files of a running twin, in a repeated job."""

    def __init__(self, gallery: Gallery, running: RunningTwin) -> None:
        self._gallery, self._running = gallery, running
        self._files = running.opening.files
        self._known = self._seen = running.opening.stamp
        if running.opening.again is not None:
            running.engine.jobs.run("saved files", self.check, every=FILE_POLL_PERIOD_S)

    def check(self, job: Job | None = None) -> None:
        """Look once; reload when a file has changed since it was read, but not since the last look."""
        running, again = self._running, self._running.opening.again
        assert again is not None
        stamp = stamp_of(self._files)
        settled, self._seen = stamp == self._seen, stamp
        if settled and stamp != self._known and self._gallery.starting is None:
            changed = [file for file, was, now in zip(self._files, self._known, stamp, strict=True) if was != now]
            self._known = stamp
            self._read(running, ", ".join(shown_path(file) for file in changed), again)

    def _watch(self, files: tuple[Path, ...]) -> None:
        """Watch these files, from which the twin was just read."""
        known = dict(zip(self._files, self._known, strict=True))
        self._files = files
        self._known = self._seen = tuple(known.get(file, *stamp_of((file,))) for file in files)

    def _read(self, running: RunningTwin, what: str, again: Callable[[], Twin]) -> None:
        engine = running.engine
        try:
            twin = again()
            self._watch(twin.files)
            chosen = engine.twin.overrides.get(VERSION, OWN_VALUES)
            if chosen != twin.overrides.get(VERSION, OWN_VALUES):
                # Loaded on the page.
                twin = with_version(twin, chosen)
            reason = obstacle(engine.twin, twin)
            if reason is None:
                self._gallery.opener.prepare(twin)
        except (NisusError, OSError) as error:
            self._refuse(running, str(error).splitlines()[0])
            return
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            self._refuse(running, f"{what}: {type(error).__name__}: {error}")
            return
        running.server.unread = None
        if twin.config == engine.twin.config and what == shown_path(twin.path):
            return  # only a comment changed
        if reason is not None:
            self._gallery.again(f"{what} was saved and {reason}: the twin was started anew")
            return
        engine.notices.say(f"{what} was saved: the history is folded again with it")
        engine.reload(twin, f"{Path(what).name} saved")

    def _refuse(self, running: RunningTwin, text: str) -> None:
        running.server.unread = text
        running.engine.notices.say(f"not read again: {text}", level="error")
