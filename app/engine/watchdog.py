"""Watchdog for folds that do not return: name the function of the model that keeps them.

Compiled code cannot be interrupted, so the engine's thread is lost then. It holds no interpreter lock, so signals,
page and recorder still run; they read the last state, which nothing changes any more.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import wait
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from config.loader import shown_path
from estimators.fold import Fold
from estimators.fold_failures import questions_of
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.jit import plain

from ..terminal import complain
from .jobs import start_in_thread

CALL_TIMEOUT_S = 10.0
"""Seconds that one call of a model's function may take before a line names it."""

CHECK_AFTER_S = 3.0
"""Seconds that a fold may take before the functions of its model are called one by one."""

STALLED_AFTER_S = 60.0
"""Seconds after which a fold is reported although each of its functions returns."""

ANSWER_TIMEOUT_S = 1.0
"""Seconds for one function to return."""

STALLED_REMEDY = "the estimate stays as it is. Ctrl-C ends the program; correct the model"


class CallWatch:
    """Finds a call of a model's Python function that does not return, in whatever thread it is."""

    def __init__(self, model: StateSpaceModel, clock: Callable[[], float] = time.monotonic) -> None:
        functions = [("f", model.f), ("F", model.F), ("Q", model.Q), ("shape", model.shape)]
        for sensor in model.sensors:
            for what in ("h", "H", "log_likelihood"):
                functions.append((f"{what} of sensor {sensor.name}", getattr(sensor, what)))
        if model.jump is not None:
            functions.append(("jump.chances", model.jump.chances))
        codes = ((getattr(plain(item), "__code__", None), what) for what, item in functions)
        self._names = {code: what for code, what in codes if code is not None}
        self._model = model.name
        self._clock = clock
        self._seen: tuple[FrameType, float] | None = None

    def check(self) -> str | None:
        """Return a line once a call has taken `CALL_TIMEOUT_S`; None otherwise."""
        frame = self._call()
        if frame is None:
            self._seen = None
        elif self._seen is None or self._seen[0] is not frame:
            self._seen = (frame, self._clock())
        elif self._clock() - self._seen[1] >= CALL_TIMEOUT_S:
            self._seen = (frame, float("inf"))
            return (
                f"{self._place(frame)} has not returned for {CALL_TIMEOUT_S:g} s; if it never ends, Ctrl-C ends the "
                "program"
            )
        return None

    def where(self) -> str | None:
        """Return the present call and its place."""
        frame = self._call()
        return None if frame is None else self._place(frame)

    def _place(self, frame: FrameType) -> str:
        code = frame.f_code
        return f"{shown_path(Path(code.co_filename))}:{frame.f_lineno}: {self._names[code]} of the model {self._model}"

    def _call(self) -> FrameType | None:
        for thread_frame in sys._current_frames().values():
            frame: FrameType | None = thread_frame
            while frame is not None:
                if frame.f_code in self._names:
                    return frame
                frame = frame.f_back
        return None


class Watchdog:
    """Watches the folds of one thread from another."""

    def __init__(
        self,
        say: Callable[[str, str], object],
        *,
        then: str = STALLED_REMEDY,
        long: float = STALLED_AFTER_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to watch.

        Args:
            say: Called with a line and its level ("error", "info").
            then: Consequence and remedy, at the end of the line.
            long: Seconds after which a fold is reported although each function returns.
            clock: Monotonic seconds.
        """
        self._say = say
        self._then = then
        self._long = long
        self._clock = clock
        self._work: tuple[float, Fold] | None = None
        self._asked: tuple[float, Fold] | None = None
        self.text: str | None = None
        """Line about the fold that does not return; None while all is well."""

    @property
    def busy(self) -> float:
        """Seconds since the present fold began; 0 while there is none."""
        work = self._work
        return 0.0 if work is None else self._clock() - work[0]

    @contextmanager
    def watched(self, fold: Fold) -> Iterator[None]:
        """Watch a block that folds."""
        self._work = (self._clock(), fold)
        try:
            yield
        finally:
            self._work = None

    def check(self) -> None:
        """Look once at the duration of the present fold."""
        work = self._work
        if work is None or work is not self._asked:
            if self.text is not None:
                self.text = None
                self._say("the fold has returned, and goes on", "info")
            self._asked = None
        if work is None or self.text is not None or (gone := self._clock() - work[0]) < CHECK_AFTER_S:
            return
        if self._asked is None:
            self._asked = work
            guilty = _in_python(work[1]) or unanswered(questions_of(work[1]))
        elif gone >= self._long:
            guilty = "a fold"
        else:
            return
        if guilty is not None and self._work is work:
            self.text = f"{guilty} has not returned for {gone:.0f} s; {self._then}"
            self._say(self.text, "error")


def interruptible(fold: Fold, work: Callable[[], object]) -> None:
    """Run work that folds in a thread that may be left behind, so that Ctrl-C ends even a call that never returns.

    A function of the fold's model that does not return is named on standard error. Raises as the work.
    """
    watchdog = Watchdog(lambda text, level: complain(text))

    def run() -> None:
        with watchdog.watched(fold):
            work()

    over = start_in_thread(run, "fold")
    while not over.done():
        wait([over], 0.5)
        watchdog.check()
    over.result()


def _in_python(fold: Fold) -> str | None:
    """Return the function of a black box that a thread is in."""
    return CallWatch(fold.model).where() if fold.model.black_box else None


def unanswered(questions: Iterable[tuple[str, Callable[[], object]]], timeout: float | None = None) -> str | None:
    """Return the name of the first function that does not return within `timeout` seconds; None if all do.

    They are called in a thread of its own, which is lost with the one that does not return.
    """
    asking: list[str] = []
    over = threading.Event()

    def call_all() -> None:
        try:
            for what, question in questions:
                asking.append(what)
                question()
        finally:
            over.set()

    threading.Thread(target=call_all, name="asking", daemon=True).start()
    known = -1
    while not over.wait(ANSWER_TIMEOUT_S if timeout is None else timeout):
        if asking and len(asking) == known:
            return asking[-1]
        known = len(asking)
    return None
