"""A fold that does not return: which function of the model keeps it, said while everything else goes on.

Compiled code cannot be interrupted, so the engine's thread is lost then. It holds no interpreter lock, so signals,
page and recorder still run; they read what stood before, which nobody changes any more.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from estimators.fold_failures import questions_of

from ..stderr import complain
from .call_watch import CallWatch

if TYPE_CHECKING:
    from estimators.fold import Fold

PATIENCE = 3.0
"""Seconds that a fold may take before the functions of its model are asked one by one."""

LONG = 60.0
"""Seconds after which a fold is said not to return although each of them answers."""

ANSWER = 1.0
"""Seconds for one of them to answer."""


LOST = "nothing more is estimated. Ctrl-C ends the program; mend the model"


class Stall:
    """Watches the work of one thread from another."""

    def __init__(
        self,
        say: Callable[[str, str], Any],
        *,
        then: str = LOST,
        long: float = LONG,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to watch.

        Args:
            say: Called with a line and how bad it is ("error", "info").
            then: What becomes of it, at the end of the line.
            long: Seconds after which a fold is said not to return although each function answers.
            clock: Seconds that only rise.
        """
        self._say = say
        self._then = then
        self._long = long
        self._clock = clock
        self._work: tuple[float, Fold] | None = None
        self._asked: tuple[float, Fold] | None = None
        self.text: str | None = None
        """What does not return; None while all is well."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stall", daemon=True)

    def start(self) -> None:
        """Watch until `stop`."""
        self._thread.start()

    def stop(self) -> None:
        """Watch no longer."""
        self._stop.set()

    @property
    def busy(self) -> float:
        """For how many seconds the present work has been going on; 0 while there is none."""
        work = self._work
        return 0.0 if work is None else self._clock() - work[0]

    @contextmanager
    def watched(self, fold: Fold) -> Iterator[None]:
        """Around work that folds."""
        self._work = (self._clock(), fold)
        try:
            yield
        finally:
            self._work = None

    def _run(self) -> None:
        while not self._stop.wait(0.5):
            self.look()

    def look(self) -> None:
        """Look once at how long the present work has taken."""
        work = self._work
        if work is None or work is not self._asked:
            if self.text is not None:
                self.text = None
                self._say("the fold has returned, and goes on", "info")
            self._asked = None
        if work is None or self.text is not None or (gone := self._clock() - work[0]) < PATIENCE:
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


def interruptible(fold: Fold, work: Callable[[], Any]) -> None:
    """Do work that folds in a thread that may be left behind, so that Ctrl-C ends it even in a call without end.

    Args:
        fold: What is folded; a function of its model that does not return is named on standard error.
        work: What to do.

    Raises:
        BaseException: What the work raises.
    """
    failure: list[BaseException] = []
    stall = Stall(lambda text, level: complain(text))

    def run() -> None:
        try:
            with stall.watched(fold):
                work()
        except BaseException as error:  # noqa: BLE001  raised again below, in the caller's thread
            failure.append(error)

    thread = threading.Thread(target=run, name="fold", daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(0.5)
        stall.look()
    if failure:
        raise failure[0]


def _in_python(fold: Fold) -> str | None:
    """The function of a model that is not compiled in which a thread is."""
    return CallWatch(fold.model).where() if fold.model.black_box else None


def unanswered(questions: Iterable[tuple[str, Callable[[], Any]]], patience: float | None = None) -> str | None:
    """The first question that is not answered within `patience` seconds (default: `ANSWER`); None if all are.

    They are asked in a thread of its own, which is lost with the one that is not.
    """
    asking: list[str] = []
    over = threading.Event()

    def ask() -> None:
        try:
            for what, question in questions:
                asking.append(what)
                question()
        finally:
            over.set()

    threading.Thread(target=ask, name="asking", daemon=True).start()
    known = -1
    while not over.wait(ANSWER if patience is None else patience):
        if asking and len(asking) == known:
            return asking[-1]
        known = len(asking)
    return None
