"""Revisions of a running twin: settings and changes of each, and the whole track of a few; undo and redo.

The engine adds a revision when one fold replaces another; their scores are computed on request in
app/derive/run_scores.py.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from estimators.diagnostics.episodes import Episode
from estimators.errors import ConfigError, printable
from estimators.tuning import Tuning

from ..twin.changes import SettingChange, difference, in_words, units_of
from .copies import Pull

MAX_PINNED = 4

MAX_REVISIONS = 200
"""Revisions that are kept; beyond that the oldest ones without pin, name or note are dropped, but not the first."""

MAX_UNDO = 100
"""Edits that can be taken back."""

MAX_NAME_LENGTH, MAX_NOTE_LENGTH = 60, 2000


@dataclass(frozen=True)
class Revision:
    """One revision.

    `began` is the time of its start, s since 1970, `changes` the differences from the one before. `loaded` is the
    number of the earlier revision whose tuning it took up again. `place` is one of the `MAX_PINNED` while it is
    pinned. `why` names another reason than settings: a file that was saved. `first` is whether its settings are those
    with which the session began, `gesture` that of its edits. `track` has all its rows, of the newest previous revision
    and of pinned ones. `episodes` are those at its end, which the settings of the next one may hide.
    """

    number: int
    estimator: str
    tuning: Tuning
    began: float
    changes: tuple[SettingChange, ...] = ()
    loaded: int | None = None
    name: str = ""
    note: str = ""
    place: int | None = None
    why: str = ""
    first: bool = False
    gesture: str = ""
    track: Pull | None = None
    episodes: tuple[Episode, ...] = ()

    @property
    def pinned(self) -> bool:
        """Whether it stays on the charts."""
        return self.place is not None

    @property
    def marked(self) -> bool:
        """Whether a user wants it kept."""
        return self.pinned or bool(self.name or self.note)


EditedSettings = tuple[str, Tuning]
"""An estimator and its tuning."""


@dataclass(frozen=True)
class SettingsEdit:
    """One edit of a user, or all of one gesture: settings before and after it."""

    before: EditedSettings
    after: EditedSettings
    gesture: str = ""

    @cached_property
    def words(self) -> str:
        """The change in words."""
        return in_words(difference(*self.before, *self.after), units=units_of(*self.after))


class EditHistory:
    """Edits that can be taken back, and those that were; shared by all clients."""

    def __init__(self) -> None:
        # Replaced, never changed, so that a reader in another thread never sees half of it.
        self.done: tuple[SettingsEdit, ...] = ()
        self.undone: tuple[SettingsEdit, ...] = ()

    def add(self, before: EditedSettings, after: EditedSettings, gesture: str = "") -> None:
        """Add an edit; one of the same gesture as the last extends that."""
        if gesture and self.done and self.done[-1].gesture == gesture:
            edit, self.done = self.done[-1], self.done[:-1]
            before = edit.before
        self.done = (*self.done, SettingsEdit(before, after, gesture))[-MAX_UNDO:]
        self.undone = ()

    def next(self, *, again: bool) -> SettingsEdit:
        """Return the edit that `step` would take back, or make again.

        Raises:
            ConfigError: If there is none.
        """
        edits = self.undone if again else self.done
        if not edits:
            raise ConfigError("Redo: no edit was taken back" if again else "Undo: there is no edit to take back")
        return edits[-1]

    def step(self, *, again: bool) -> EditedSettings:
        """Take the last edit back, or make it again; return the settings to which that leads. Raises as `next`."""
        edit = self.next(again=again)
        if again:
            # Another value of its gesture would be an edit of its own.
            self.done, self.undone = (*self.done, replace(edit, gesture="")), self.undone[:-1]
            return edit.after
        self.done, self.undone = self.done[:-1], (*self.undone, edit)
        return edit.before

    def forget(self) -> None:
        """Forget all edits: they belong to another twin."""
        self.done = self.undone = ()


class Revisions:
    """All revisions, oldest first; the last one runs. Changed by the engine's thread alone, read by any."""

    def __init__(self, estimator: str, tuning: Tuning, *, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self.runs: tuple[Revision, ...] = (Revision(0, estimator, tuning, clock(), first=True),)
        self.edits = EditHistory()
        self.version = 0
        """Incremented by every change, so that a page knows when to ask again."""
        self.why = ""
        """Reason of the next revision, if not another setting."""
        self.watchers: set[Callable[[], None]] = set()
        """Called at every change, in its thread: they must neither wait nor fail."""
        self.said: Callable[[int], tuple[Episode, ...]] = lambda number: ()
        """Returns the episodes of the running revision."""

    def restore(self, runs: tuple[Revision, ...]) -> None:
        """Take over the revisions of an earlier process; the last one runs."""
        self._become([*runs])

    def began_with(self, estimator: str, tuning: Tuning) -> None:
        """Begin with the first fold, whose settings may have been changed while it was compiled."""
        *earlier, running = self.runs
        self._become([*earlier, replace(running, estimator=estimator, tuning=tuning)])

    def left(self, pull: Pull, estimator: str, tuning: Tuning, gesture: str = "") -> None:
        """Replace the running revision, whose rows are `pull`, by the next, of that estimator and tuning.

        Edits of one gesture are one revision: the values on the way are dropped; an edit of its own has an empty one. A
        revision that is taken up again (`Revision.loaded`) continues under the new number, with its name.
        """
        *earlier, running = self.runs
        now = self._clock()
        same = [run for run in self.runs if run.tuning is tuning and run.estimator == estimator]
        if running in same:
            self.restarted(pull.revision + 1, keep=True)
            return
        changes = difference(running.estimator, running.tuning, estimator, tuning)
        why, self.why = self.why, ""
        if earlier and not same and not why and gesture and gesture == running.gesture and not running.marked:
            before = earlier[-1]
            changes = difference(before.estimator, before.tuning, estimator, tuning)
        else:
            earlier = [*map(_without_track, earlier), replace(running, track=pull, episodes=self.said(running.number))]
        begun = Revision(pull.revision + 1, estimator, tuning, now, changes, why=why, gesture=gesture)
        if same:
            first = any(run.first for run in same)
            begun = replace(begun, loaded=same[0].number, name=same[-1].name, note=same[-1].note, first=first)
            earlier = [run for run in earlier if run.pinned or all(run.number != other.number for other in same)]
        surplus = max(0, len(earlier) + 1 - MAX_REVISIONS)
        forgotten = [run.number for run in earlier[:-1] if not (run.marked or run.first)][:surplus]
        self._become([*(run for run in earlier if run.number not in forgotten), begun])

    def restarted(self, number: int, *, keep: bool = False) -> None:
        """Continue the running revision under another number: folded again, or over a log that has begun again.

        The previous track is kept if the log is still the same, so that it remains comparable.
        """
        *earlier, running = self.runs
        kept = earlier if keep else [replace(_without_track(run), episodes=()) for run in earlier]
        self._become([*kept, replace(running, number=number)])

    def previous(self) -> Pull | None:
        """Return all rows of the newest previous revision (before a drag that goes on); its arrays never change."""
        runs = self.runs
        return runs[-2].track if len(runs) > 1 else None

    def find(self, number: int) -> Revision:
        """Return the revision of that number.

        Raises:
            ConfigError: If it is not known.
        """
        for run in self.runs:
            if run.number == number:
                return run
        raise ConfigError(f"run {number} is not known; /api/runs lists those that are")

    def free_place(self, number: int) -> int:
        """Return the place for pinning a revision: its own, or the first free one.

        Raises:
            ConfigError: If it is not known, or no place is free.
        """
        run = self.find(number)
        if run.place is not None:
            return run.place
        taken = {other.place: other.number for other in self.runs if other.place is not None}
        if len(taken) == MAX_PINNED:
            names = ", ".join(map(str, sorted(taken.values())))
            raise ConfigError(f"run {number} cannot be pinned: {MAX_PINNED} are ({names}); unpin one first")
        return min(set(range(MAX_PINNED)) - set(taken))

    def pin(self, number: int) -> None:
        """Keep a revision on the charts; a track that is gone is folded again. Raises as `free_place`."""
        self._change(number, place=self.free_place(number))

    def unpin(self, number: int) -> None:
        """Unpin a revision, and drop its track; raises as `find`."""
        self._change(number, place=None)
        self._become([*map(_without_track, self.runs[:-2]), *self.runs[-2:]])

    def describe(self, number: int, name: str, note: str) -> None:
        """Give a revision a name and a note; raises as `check_words`."""
        self.check_words(number, name, note)
        self._change(number, name=" ".join(printable(name).split()), note=printable(note).strip())

    def check_words(self, number: int, name: str, note: str) -> None:
        """Reject a name or note that is too long.

        Raises:
            ConfigError: If they are, or the revision is not known.
        """
        self.find(number)
        for what, text, most in (("name", name, MAX_NAME_LENGTH), ("note", note, MAX_NOTE_LENGTH)):
            if len(text) > most:
                raise ConfigError(f"run {number}: its {what} has {len(text)} characters; it may have {most}")

    def _change(self, number: int, **fields: object) -> None:
        found = self.find(number)
        self._become([replace(run, **fields) if run is found else run for run in self.runs])  # type: ignore[arg-type]

    def _become(self, runs: list[Revision]) -> None:
        # At once, so that a reader in another thread never sees half of it.
        self.runs = tuple(runs)
        self.version += 1
        for notify in tuple(self.watchers):
            notify()


def _without_track(run: Revision) -> Revision:
    return run if run.pinned or run.track is None else replace(run, track=None)
