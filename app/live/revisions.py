"""Every revision of a running twin: with what it was folded, what that changed, and the whole track of a few.

Bookkeeping alone. The engine says when a revision gives way to the next; what each was worth is computed elsewhere
(app/live/runs/scores.py), when somebody asks.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from estimators.diagnostics.episodes import Episode
from estimators.errors import ConfigError, printable
from estimators.tuning import Tuning

from .changes import Change, difference
from .outputs import Pull

DRAG = 2.0
"""Seconds within which edits of one entry are one edit."""

MOST_PINNED = 4

MOST = 200
"""Revisions that are kept; of more the oldest that nobody pinned or named are forgotten."""

LONGEST_NAME, LONGEST_NOTE = 60, 2000


@dataclass(frozen=True)
class Run:
    """One revision.

    `began` is when it took the place of the one before, s since 1970, `changes` what differs from that. `loaded` is the
    number of the earlier revision whose tuning it took up again. `place` is one of the `MOST_PINNED` while it is
    pinned. `why` says what beside settings changed: a file that was saved. `track` is all that it concluded until it
    gave way: of the newest previous revision and of pinned ones. `episodes` are what was wrong until then, which the
    settings of the next one may hide.
    """

    number: int
    estimator: str
    tuning: Tuning
    began: float
    changes: tuple[Change, ...] = ()
    loaded: int | None = None
    name: str = ""
    note: str = ""
    place: int | None = None
    why: str = ""
    track: Pull | None = None
    episodes: tuple[Episode, ...] = ()

    @property
    def pinned(self) -> bool:
        """Whether its track is kept."""
        return self.place is not None

    @property
    def marked(self) -> bool:
        """Whether a user wants it kept."""
        return self.pinned or bool(self.name or self.note)


class Revisions:
    """All of them, oldest first; the last is the one that runs. Changed by the engine's thread alone, read by any."""

    def __init__(self, estimator: str, tuning: Tuning, *, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self.runs: tuple[Run, ...] = (Run(0, estimator, tuning, clock()),)
        self.version = 0
        """Counts up with every change, so that a page knows when to ask again."""
        self.why = ""
        """Why the next revision is folded, if not for another setting."""
        self.watchers: set[Callable[[], None]] = set()
        """Called at every change, by the thread that makes it: they must neither wait nor fail."""
        self.said: Callable[[int], tuple[Episode, ...]] = lambda number: ()
        """Gives the episodes of the revision that runs."""

    def began_with(self, estimator: str, tuning: Tuning) -> None:
        """The first fold could be had; meanwhile its settings may have been turned."""
        *earlier, running = self.runs
        self._become([*earlier, replace(running, estimator=estimator, tuning=tuning)])

    def left(self, pull: Pull, estimator: str, tuning: Tuning) -> None:
        """The revision that ran gives way to the next.

        Edits of one entry that follow each other quickly are one: those between the first and the last are forgotten.
        A revision that is taken up again (`Run.loaded`) goes on under the new number, with its name.

        Args:
            pull: All of the revision that ends.
            estimator: Of the one that begins.
            tuning: The same.
        """
        *earlier, running = self.runs
        now = self._clock()
        same = [run for run in self.runs if run.tuning is tuning and run.estimator == estimator]
        if running in same:
            self.restarted(pull.revision + 1, keep=True)
            return
        changes = difference(running.estimator, running.tuning, estimator, tuning)
        why, self.why = self.why, ""
        dragged = bool(earlier) and not same and not why and now - running.began < DRAG and _of_one(running, changes)
        if dragged:
            before = earlier[-1]
            changes = difference(before.estimator, before.tuning, estimator, tuning)
        else:
            earlier = [*map(_without_track, earlier), replace(running, track=pull, episodes=self.said(running.number))]
        begun = Run(pull.revision + 1, estimator, tuning, now, changes, why=why)
        if same:
            begun = replace(begun, loaded=same[0].number, name=same[-1].name, note=same[-1].note)
            earlier = [run for run in earlier if run.pinned or all(run.number != other.number for other in same)]
        self._become(_few([*earlier, begun]))

    def restarted(self, number: int, *, keep: bool = False) -> None:
        """What runs goes on under another number: folded again as it was, or over a log that has begun again.

        Args:
            number: The new one.
            keep: Whether the log is still the same, so that the previous track can be compared with.
        """
        *earlier, running = self.runs
        kept = earlier if keep else [replace(_without_track(run), episodes=()) for run in earlier]
        self._become([*kept, replace(running, number=number)])

    def previous(self) -> Pull | None:
        """All of the newest previous revision; its arrays never change."""
        runs = self.runs
        return runs[-2].track if len(runs) > 1 else None

    def find(self, number: int) -> Run:
        """The revision of that number.

        Raises:
            ConfigError: If it is not known.
        """
        for run in self.runs:
            if run.number == number:
                return run
        raise ConfigError(f"run {number} is not known; /api/runs lists those that are")

    def free_place(self, number: int) -> int:
        """Where a revision can be pinned: its own place, or the first that is free.

        Raises:
            ConfigError: If it is not known, its track is gone, or there is no place.
        """
        run = self.find(number)
        if run.place is not None:
            return run.place
        if run.track is None and run is not self.runs[-1]:
            raise ConfigError(f"run {number} cannot be pinned: its track is gone; load it, and it is folded again")
        taken = {other.place: other.number for other in self.runs if other.place is not None}
        if len(taken) == MOST_PINNED:
            names = ", ".join(map(str, sorted(taken.values())))
            raise ConfigError(f"run {number} cannot be pinned: {MOST_PINNED} are ({names}); unpin one first")
        return min(set(range(MOST_PINNED)) - set(taken))

    def pin(self, number: int) -> None:
        """Keep a revision's track; raises as `free_place`."""
        self._change(number, place=self.free_place(number))

    def unpin(self, number: int) -> None:
        """Keep it no longer.

        Raises:
            ConfigError: If the revision is not known.
        """
        self._change(number, place=None)
        self._become([*map(_without_track, self.runs[:-2]), *self.runs[-2:]])

    def describe(self, number: int, name: str, note: str) -> None:
        """Give a revision a name and a note; raises as `check_words`."""
        self.check_words(number, name, note)
        self._change(number, name=" ".join(printable(name).split()), note=printable(note).strip())

    def check_words(self, number: int, name: str, note: str) -> None:
        """Refuse words that are too long.

        Raises:
            ConfigError: If they are, or the revision is not known.
        """
        self.find(number)
        for what, text, most in (("name", name, LONGEST_NAME), ("note", note, LONGEST_NOTE)):
            if len(text) > most:
                raise ConfigError(f"run {number}: its {what} has {len(text)} characters; it may have {most}")

    def _change(self, number: int, **fields: object) -> None:
        found = self.find(number)
        self._become([replace(run, **fields) if run is found else run for run in self.runs])  # type: ignore[arg-type]

    def _become(self, runs: list[Run]) -> None:
        # At once, so that a reader in another thread never sees half of it.
        self.runs = tuple(runs)
        self.version += 1
        for told in tuple(self.watchers):
            told()


def _of_one(running: Run, changes: tuple[Change, ...]) -> bool:
    """Whether both were edits of the same single entry, and nobody wants what lay between."""
    keys = [change.key for change in changes]
    return len(keys) == 1 and keys == [change.key for change in running.changes] and not running.marked


def _without_track(run: Run) -> Run:
    return run if run.pinned or run.track is None else replace(run, track=None)


def _few(runs: list[Run]) -> list[Run]:
    surplus = len(runs) - MOST
    forgotten = [run.number for run in runs[:-2] if not run.marked][: max(0, surplus)]
    return [run for run in runs if run.number not in forgotten]
