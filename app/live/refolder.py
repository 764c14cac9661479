"""Folds the whole history again beside the running twin: another estimator, another tuning."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from estimators.errors import NisusError
from estimators.fold import Fold

from .pieces import Pieces
from .stall import Stall


@dataclass(frozen=True)
class Refolded:
    """A finished fold over a copy of the log, or why there is none; `ticket` says which request it answers."""

    ticket: int
    fold: Fold | None
    error: str


class Requests:
    """The refolds that were asked for, and from which event on the log has changed since each was."""

    def __init__(self) -> None:
        self.newest = 0
        self._answered = 0
        self._open: dict[int, int | None] = {}

    @property
    def waiting(self) -> bool:
        """Whether the newest has no answer yet."""
        return self._answered != self.newest

    def ask(self) -> int:
        """Another one, over the log as it is now; its ticket."""
        self.newest += 1
        self._open[self.newest] = None
        return self.newest

    def changed(self, index: int) -> None:
        """The log changed from an event (its absolute index) on."""
        for ticket, known in self._open.items():
            self._open[ticket] = index if known is None else min(known, index)

    def look(self, ticket: int) -> tuple[bool, int | None]:
        """A refold is done: whether its log is still the present one, and from where on that has changed."""
        return ticket in self._open, self._open.get(ticket)

    def answer(self, ticket: int) -> None:
        """Of this request, and of those before it, nothing more comes."""
        self._answered = max(self._answered, ticket)
        self._open = {number: index for number, index in self._open.items() if number > ticket}

    def forget(self) -> None:
        """The log has started again, so no answer fits it."""
        self._answered = self.newest
        self._open.clear()


GIVEN_UP = "what ran before goes on. Mend the model, or choose another tuning"


class Refolder:
    """One thread, one fold at a time; of the requests that come meanwhile only the latest counts."""

    def __init__(self, done: Callable[[Refolded], None]) -> None:
        self._done = done
        self._wake = threading.Condition()
        self._pending: tuple[int, Callable[[], Fold]] | None = None
        self._busy = False
        self._stopping = False
        self._ticket = 0
        # A long history may take minutes: only a function that does not answer ends a refold.
        self._stall = Stall(self._give_up, then=GIVEN_UP, long=math.inf)
        self._thread = threading.Thread(target=self._run, name="refold", daemon=True)

    def start(self) -> None:
        """Wait for requests."""
        self._thread.start()
        self._stall.start()

    def stop(self) -> None:
        """Give up what is under way."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        self._stall.stop()

    def _give_up(self, text: str, level: str) -> None:
        """A function of the model never returns: leave the thread in it, and go on with another."""
        if level != "error":
            return
        with self._wake:
            self._thread = threading.Thread(target=self._run, name="refold", daemon=True)
            self._thread.start()
        self._done(Refolded(self._ticket, None, text))

    def request(self, ticket: int, make: Callable[[], Fold]) -> None:
        """Fold what `make` prepares (in this thread: it may have to compile), as soon as the present one is done."""
        with self._wake:
            self._pending = (ticket, make)
            self._wake.notify()

    @property
    def busy(self) -> bool:
        """Whether a fold is under way or waiting."""
        with self._wake:
            return self._busy or self._pending is not None

    def _run(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                while self._pending is None and not self._stopping:
                    self._wake.wait()
                if self._stopping:
                    return
                assert self._pending is not None
                ticket, make = self._pending
                self._pending, self._ticket = None, ticket
                self._busy = True
            answer = self._fold(ticket, make)
            with self._wake:
                if threading.current_thread() is not self._thread:
                    return
            self._done(answer)

    def _fold(self, ticket: int, make: Callable[[], Any]) -> Refolded:
        try:
            fold, pieces = make(), Pieces()
            with self._stall.watched(fold):
                while pieces.advance(fold) and not self._stopping:
                    pass
        except NisusError as error:
            return Refolded(ticket, None, str(error))
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the running fold goes on
            return Refolded(ticket, None, f"{type(error).__name__}: {error}")
        return Refolded(ticket, fold, "")
