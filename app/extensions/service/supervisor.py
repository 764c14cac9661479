"""Processes that are watched: one that ends or does not answer is started again, later after each failure."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from typing import Any

from app.engine.jobs import LoopThread
from app.result import JsonObject
from app.terminal import print_line
from estimators.track import HEALTH_NAMES

STARTING, RUNNING, STOPPED, FAILED = "starting", "running", "stopped", "failed"
"""States of a twin's process."""

STATUS_PERIOD_S = 1.0
"""Seconds between two reports of a twin to the service."""

MAX_SILENCE_S = 30.0
"""Seconds without a report after which a running process is killed and started again."""

MAX_START_S = 900.0
"""The same while it starts, which may compile filters."""

STOP_TIMEOUT_S = 10.0
"""Seconds for which a process may write its store and recording."""

FIRST_RETRY_S, MAX_RETRY_S = 1.0, 60.0
"""Wait before a process that has ended is started again: doubled after each failure, and at most."""

STEADY_S = 30.0
"""A process that ran for so long begins with the first wait again."""

FOLDER_PERIOD_S = 2.0
"""Seconds between two looks at the folder of twins."""


@dataclass
class ServedTwin:
    """A twin of the service, and its process.

    `text` is the reason of a failure, and `failure` that of the last one. `card` describes the twin, once it has been
    read, and `report` its estimate. `noted` are requests for its audit log, which wait until it runs.
    """

    name: str
    path: str
    state: str = STARTING
    text: str = ""
    failure: str = ""
    wanted: bool = True
    process: multiprocessing.process.BaseProcess | None = None
    pipe: Connection | None = None
    port: int = 0
    token: str = ""
    began: float = 0.0
    heard: float = 0.0
    due: float = 0.0
    wait: float = FIRST_RETRY_S
    starts: int = 0
    card: Mapping[str, object] = field(default_factory=dict)
    report: Mapping[str, object] = field(default_factory=dict)
    noted: list[tuple[object, ...]] = field(default_factory=list)

    @property
    def rank(self) -> tuple[int, str]:
        """Place in the overview: the worst first."""
        if self.state == STOPPED:
            return len(HEALTH_NAMES) + 1, self.name
        if self.state != RUNNING:
            return (-2 if self.state == FAILED else 0), self.name
        health = self.report.get("health", "")
        order = ("diverged", "stale", "degraded", "suspect", "advisory", "waiting", "tracking")
        return order.index(health) - 1 if health in order else 0, self.name

    def json(self) -> JsonObject:
        """Return its state for the overview."""
        now = time.monotonic()
        return {
            "name": self.name,
            "state": self.state,
            "text": self.text,
            "starts": self.starts,
            "pid": None if self.process is None else self.process.pid,
            "seconds": round(now - self.began, 1),
            "again_in": round(max(0.0, self.due - now), 1) if self.state == FAILED and self.wanted else None,
            **self.report,
        }


Child = Callable[[str, str, Connection], None]
"""Runs a twin, given its name, path and a pipe, in a process of its own."""


SAFE_PATH, OURS = "PYTHONSAFEPATH", "nisus"
"""Variable with which Python leaves the working directory out of its path, and its value if Nisus has set it."""


@contextmanager
def _safe_path() -> Iterator[None]:
    """Start processes that do not import from the working directory, where a file may have the name of a library."""
    unset = SAFE_PATH not in os.environ
    if unset:
        os.environ[SAFE_PATH] = OURS
    try:
        yield
    finally:
        if unset:
            del os.environ[SAFE_PATH]


def forget_safe_path() -> None:
    """In such a process: let the programs that it starts import as they are used to."""
    if os.environ.get(SAFE_PATH) == OURS:
        del os.environ[SAFE_PATH]


class Supervisor:
    """Starts the processes of twins, and watches them."""

    def __init__(
        self,
        twins: Mapping[str, str],
        child: Child,
        *,
        folder: Callable[[], Mapping[str, str]] | None = None,
        preload: Sequence[str] = (),
        at_once: int = 2,
        on_demand: bool = False,
    ) -> None:
        """Prepare; nothing runs yet.

        Args:
            twins: Paths by name.
            child: Runs one of them.
            folder: Returns the twins of a folder, which are added and removed as its files are.
            preload: Modules that the processes share.
            at_once: Processes that start at the same time.
            on_demand: Whether a process that has ended is removed, to be started again by `begin`.
        """
        self.twins = {name: ServedTwin(name, path) for name, path in twins.items()}
        self.changing = threading.RLock()
        """Held while the twins are changed."""
        self._child, self._folder, self._at_once, self._on_demand = child, folder, at_once, on_demand
        self._looked = time.monotonic()
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if preload and "forkserver" in methods:
            self._context.set_forkserver_preload(list(preload))
        self._thread = LoopThread(self._watch, "service")

    # From any thread

    def start(self) -> None:
        """Begin."""
        if self._on_demand and self._context.get_start_method() == "forkserver":
            with _safe_path():
                forkserver.ensure_running()  # so that it has the modules when the first page is opened
        self._thread.start()

    def stop(self) -> None:
        """Stop all processes, concurrently."""
        self._thread.stop(5.0)
        for twin in self.twins.values():
            self.ask_to_stop(twin)
        end = time.monotonic() + STOP_TIMEOUT_S
        for twin in self.twins.values():
            self._end(twin, end)

    def note(self, twin: ServedTwin, entry: tuple[object, ...]) -> None:
        """Pass a request on to the audit log of a twin."""
        with self.changing:
            twin.noted.append(entry)
            self._send_noted(twin)

    def _send_noted(self, twin: ServedTwin) -> None:
        if twin.pipe is not None and twin.port:
            with suppress(OSError, ValueError):
                for entry in twin.noted:
                    twin.pipe.send(("audit", entry))
            twin.noted.clear()

    # In the supervisor's thread

    def _watch(self) -> None:
        while not self._thread.stopping.is_set():
            twins = list(self.twins.values())
            pipes: dict[object, ServedTwin] = {twin.pipe: twin for twin in twins if twin.pipe is not None}
            waited: list[Any] = [*pipes, *(twin.process.sentinel for twin in twins if twin.process is not None)]
            for pipe in set(wait(waited, 0.2)) & set(pipes) if waited else self._rest():
                self._listen(pipes[pipe])
            with self.changing:
                self._look()

    def _rest(self) -> set[Connection]:
        self._thread.stopping.wait(0.2)
        return set()

    def _listen(self, twin: ServedTwin) -> None:
        """Take a message of a twin's process: (kind, content)."""
        assert twin.pipe is not None
        try:
            kind, content = twin.pipe.recv()
        except (EOFError, OSError):
            twin.pipe.close()
            twin.pipe = None
            return
        twin.heard = time.monotonic()
        if kind == "ready":
            twin.port, twin.token, twin.card = content
            twin.state, twin.text = RUNNING, ""
            with self.changing:
                self._send_noted(twin)
        elif kind == "report":
            twin.report = content
        elif kind == "failed":
            twin.text = content

    def _look(self) -> None:
        """Start processes that are due, and note those that have ended."""
        now = time.monotonic()
        if self._folder is not None and now - self._looked > FOLDER_PERIOD_S:
            self._looked = now
            self._look_at_folder(self._folder())
        starting = sum(twin.process is not None and twin.state == STARTING for twin in self.twins.values())
        for twin in list(self.twins.values()):
            if twin.process is None:
                if twin.wanted and now >= twin.due and starting < self._at_once:
                    self.begin(twin)
                    starting += 1
            elif not twin.process.is_alive():
                self._note_end(twin)
            elif now - twin.heard > (MAX_SILENCE_S if twin.state == RUNNING else MAX_START_S):
                twin.text = f"did not answer for {now - twin.heard:.0f} s"
                twin.process.kill()

    def _look_at_folder(self, found: Mapping[str, str]) -> None:
        for name, path in found.items():
            if name not in self.twins:
                print_line("info", "was added to the folder", twin=name)
                self.twins[name] = ServedTwin(name, path)
        for name in [name for name in self.twins if name not in found]:
            twin = self.twins[name]
            twin.wanted = False
            self.ask_to_stop(twin)
            if twin.process is None:
                print_line("info", "was removed from the folder", twin=name)
                del self.twins[name]

    def begin(self, twin: ServedTwin) -> None:
        """Start the process of a twin that has none; `changing` is held."""
        ours, its = self._context.Pipe()
        process = self._context.Process(target=self._child, args=(twin.name, twin.path, its), name=twin.name)
        twin.pipe, twin.state = ours, STARTING
        twin.began = twin.heard = time.monotonic()
        twin.starts += 1
        with _safe_path():
            process.start()
        twin.process = process  # not before: one that was not started cannot be waited for
        its.close()

    def _note_end(self, twin: ServedTwin) -> None:
        """Note that a process has ended; unless it was asked to, it is started again."""
        assert twin.process is not None
        while twin.pipe is not None and twin.pipe.poll():
            self._listen(twin)
        ran, code = time.monotonic() - twin.began, twin.process.exitcode or 0
        why = twin.text or (f"ended by {_signal_name(-code)}" if code < 0 else f"ended with status {code}")
        twin.process.close()
        if twin.pipe is not None:
            twin.pipe.close()
        twin.process, twin.pipe, twin.port, twin.report = None, None, 0, {}
        if self._on_demand:
            twin.state = FAILED if twin.wanted else STOPPED
            twin.text = why
            del self.twins[twin.name]
            return
        if not twin.wanted:
            twin.state, twin.text = STOPPED, ""
            print_line("info", "stopped", twin=twin.name)
            return
        if twin.wait == 0.0:  # asked to
            twin.state, twin.wait = STARTING, FIRST_RETRY_S
            print_line("info", "stopped, to be started anew", twin=twin.name)
            return
        twin.wait = FIRST_RETRY_S if ran > STEADY_S else twin.wait
        twin.due = time.monotonic() + twin.wait
        if why != twin.failure or ran > STEADY_S:  # one that cannot start at all is one line
            print_line("error", f"{why}; started again in {twin.wait:.0f} s, then less often", twin=twin.name)
        twin.failure = why
        twin.state, twin.text, twin.wait = FAILED, why, min(MAX_RETRY_S, 2 * twin.wait)

    def ask_to_stop(self, twin: ServedTwin) -> None:
        """Ask the process of a twin to stop, if there is one."""
        if twin.pipe is not None:
            with suppress(OSError, ValueError):
                twin.pipe.send(("stop", None))

    def _end(self, twin: ServedTwin, end: float) -> None:
        """Wait for a process until some time, then kill it."""
        if twin.process is None:
            return
        twin.process.join(max(0.0, end - time.monotonic()))
        if twin.process.is_alive():
            print_line("error", f"did not stop within {STOP_TIMEOUT_S:g} s; killed", twin=twin.name)
            twin.process.kill()
            twin.process.join()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
