"""Deliberate faults of a twin, the folds of its log with and without them, and when they are reported."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import nan
from typing import NamedTuple

import numpy as np

from app.twin.sources.asset import make_asset
from app.twin.twin import Twin
from config.source_schema import AssetSection, CanSection
from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.sensitivity.responses import SENSOR, SWAP, SWAPPED
from estimators.diagnostics.sensitivity.suspects import isolates, likeliest, suspects
from estimators.errors import NisusError, SourceError
from estimators.fold import Fold
from estimators.log import MARK, READING, TICK, TRUTH, Events, Log
from estimators.model.state_space import StateSpaceModel
from estimators.snapshots import Base
from estimators.track import TRACKING, USABLE, WAITING
from estimators.tuning import Tuning
from sources.faults.kinds import Fault
from sources.faults.layer import Faults, FaultySource
from sources.merged import MemorySource
from sources.simulator import Simulator
from sources.source import Source

AT_ONCE = "two at once"

ANY_SUBJECT: frozenset[str] = frozenset()
"""Subjects of a fault that concerns no particular sensor."""


@dataclass(frozen=True)
class Mistake:
    """One deliberate fault, or several at once; a row of the matrix.

    belief: factors on entries of the tuning, from the start of the log. prior: offset, in standard deviations, and
    factor on the standard deviation of the prior of a state. fault: returns the faults of the source for a window
    (start, end) in seconds of the log. An episode has the right cause if it is among `causes`, and the right subject if
    one of the most likely faults (`accused`), or the sensor of that row, is among `subjects`. A fault without causes is
    harmless and must not raise an alarm.

    size, in unit: of a constant added to a sensor or an input. shifts: whether it moves only the means of the
    innovations, equally in every log; otherwise it changes their noise or the times of events. nudges: kind, name and
    size of each as `nisus check` knows them. from_start: whether faults of the source hold over the whole log. parts:
    number of faults at once.
    """

    name: str
    causes: frozenset[str]
    subjects: frozenset[str] = ANY_SUBJECT
    belief: Mapping[str, float] = field(default_factory=dict)
    fault: Callable[[float, float], list[Fault]] | None = None
    of_asset: bool = False
    size: float = nan
    unit: str = ""
    shifts: bool = False
    prior: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    nudges: tuple[tuple[str, str, float], ...] = ()
    from_start: bool = False
    parts: int = 1

    @property
    def key(self) -> str:
        """Text in which `--only` looks for a name: pairs are chosen together."""
        return AT_ONCE if self.parts > 1 else self.name.lower()

    @property
    def whole(self) -> bool:
        """Whether it holds over the whole log."""
        return self.fault is None or self.from_start

    def right_cause(self, episode: Episode) -> bool:
        """Return whether the cause of an episode belongs to this fault."""
        return episode.cause in self.causes

    def right_subject(self, name: str) -> bool:
        """Return whether a sensor, or one of its rows, belongs to this fault."""
        return not self.subjects or not self.subjects.isdisjoint((name, name.partition(".")[0]))


class StressFold(NamedTuple):
    """A fold of a log without its true states, the same events with them, and how many came too late for it."""

    fold: Fold
    truth: Events
    stale: int


def without_truth(events: Events) -> Events:
    """Events of a log, with a question in place of each true state, so that every row stays where it is."""
    told = events.kind == TRUTH
    return events._replace(
        kind=np.where(told, TICK, events.kind).astype(np.int8),
        channel=np.where(told, 0, events.channel).astype(np.int32),
        value=np.where(told[:, None], np.nan, events.value),
    )


def asset_of(twin: Twin, seed: int) -> Simulator | None:
    """The twin's simulated asset, without an end and its seed counted up by `seed`; None if it has none."""
    section = twin.config.source
    found: AssetSection | None = section if isinstance(section, AssetSection) else None
    key: tuple[str, ...] = ("source",)
    if isinstance(section, CanSection) and section.asset is not None:
        found, key = section.asset, ("source", "asset")
    if found is None:
        return None
    changed = {"seed": found.seed + seed, "duration": None}
    return make_asset(twin.loaded, twin.model, found.model_copy(update=changed), key)


def plain_log(twin: Twin, seed: int, duration: float) -> Events:
    """Read `duration` seconds of the twin's source, without stamps; of a simulated asset with another seed.

    Raises:
        SourceError: If the source cannot be opened, or has no events.
    """
    asset = asset_of(twin, seed)
    if asset is not None:
        return _read(FaultySource(asset, twin.plan.faults()), twin.model.width, duration)
    return _read(twin.open_source(lambda key, text: None, live=False), twin.model.width, duration)


def _read(source: Source, width: int, duration: float | None = None) -> Events:
    """Read a source to its end, or the first `duration` seconds of it without fault marks."""
    parts: list[Events] = []
    try:
        while (batch := source.read(1.0)) is not None:
            parts += [batch] if len(batch) else []
            if duration is not None and parts and parts[-1].t[-1] - parts[0].t[0] > duration * 1e9:
                break
    finally:
        source.close()
    if not parts:
        raise SourceError("stress: the source has no events")
    events = Events.concat(parts, width)
    if duration is None:
        return events
    return events.select((events.kind != MARK) & (events.t <= parts[0].t[0] + round(duration * 1e9)))


class Bench:
    """A twin's log, made once, and the folds that a mistake is compared with.

    Args:
        twin: As it ships.
        seed: Of the asset, the faults and the filter.
        duration: Seconds of the log.
        begin: Share of the log after which a fault of the source begins; it lasts a third of the log.

    An error of the belief holds from the log's start on. What the twin says, it says without having been told the
    truth; that is for the scores alone.
    """

    def __init__(self, twin: Twin, seed: int, duration: float, begin: float = 1.0 / 3.0) -> None:
        self.twin, self.seed, self.duration, self.begin = twin, seed, duration, begin
        self.events = plain_log(twin, seed, duration)
        self.origin = int(self.events.t[0])
        self.length = float(self.events.t.max() - self.events.t[0]) * 1e-9
        # Folds of the log as it is, and of the mistake that is looked at, by filter and gate.
        self._calm: dict[tuple[str, float | None], StressFold] = {}
        self._wrong: dict[tuple[str, float | None], StressFold] = {}
        self._present = ""

    def window(self, mistake: Mistake) -> tuple[float, float]:
        """When a mistake lasts, seconds after the log's first event."""
        begin, third = (round(share * self.length, 3) for share in (self.begin, 1.0 / 3.0))
        return (0.0, self.length) if mistake.whole else (begin, begin + third)

    def span(self, mistake: Mistake) -> tuple[int, int]:
        """The same in ns of the log."""
        start, end = self.window(mistake)
        return self.origin + round(start * 1e9), self.origin + round(end * 1e9)

    def found_after(self, mistake: Mistake, estimator: str) -> float:
        """Return the delay of detection as a share of the fault's duration, with the twin as it ships; or infinity.

        Raises:
            NisusError: As `fold`.
        """
        start, end = self.span(mistake)
        gate = self.twin.tuning.gate
        fold, calm = (self.fold(made, estimator, gate).fold for made in (mistake, None))
        word = first_word(fold, start, calm, quiet_of(mistake))
        return _share(word, end - start)

    def found_within(self, mistake: Mistake, estimator: str, begin: int, end: int) -> float:
        """The same of a wrong belief that holds from `begin` to `end`, ns of the log, after the right one.

        Raises:
            NisusError: As `fold`.
        """
        gate = self.twin.tuning.gate
        calm = self.fold(None, estimator, gate).fold
        at, base = calm.base_at(int(np.searchsorted(calm.log.t[: calm.n], begin)))
        log = calm.log.copy()
        log.n = int(np.searchsorted(log.events.t, end))
        log.drop_front(at)
        fold = self._folded(estimator, self._tuning(estimator, mistake).set("gate", gate), log, base, mistake.prior)
        return _share(first_word(fold, begin, calm, quiet_of(mistake)), end - begin)

    def fold(self, mistake: Mistake | None, estimator: str, gate: float | None) -> StressFold:
        """The log with a mistake, or without, folded with a filter and a gate.

        Raises:
            NisusError: If the filter does not apply, or the mistake cannot be made.
        """
        if mistake is not None and mistake.name != self._present:
            self._present, self._wrong = mistake.name, {}
        made, key = self._calm if mistake is None else self._wrong, (estimator, gate)
        if key not in made:
            events = self.events if mistake is None else self._damaged(mistake)
            prior = {} if mistake is None else mistake.prior
            made[key] = self._fold(estimator, self._tuning(estimator, mistake).set("gate", gate), events, prior)
        return made[key]

    def _damaged(self, mistake: Mistake) -> Events:
        """The log as it becomes; a change of the asset needs a run of its own."""
        start, end = self.window(mistake)
        if mistake.fault is None:
            return self.events
        faults = mistake.fault(start, end)
        if not mistake.of_asset:
            layer = Faults(self.twin.model, faults, seed=self.seed)
            return _read(FaultySource(MemorySource(self.events), layer), self.twin.model.width)
        asset = asset_of(self.twin, self.seed)
        if asset is None:
            raise SourceError(f"{mistake.name}: {self.twin.name} has no simulated asset")
        layer = Faults(self.twin.model, [*self.twin.plan.scheduled, *faults], seed=self.seed)
        layer.attach(asset)
        return _read(FaultySource(asset, layer), self.twin.model.width, self.duration)

    def _tuning(self, estimator: str, mistake: Mistake | None) -> Tuning:
        tuning = replace(self.twin.tuning.with_options(self.twin.options_of(estimator)), seed=self.seed)
        for key, factor in mistake.belief.items() if mistake is not None else ():
            tuning = tuning.set(key, factor * float(tuning.get(key) or 0.0))
        return tuning

    def _fold(
        self, estimator: str, tuning: Tuning, events: Events, prior: Mapping[str, tuple[float, float]]
    ) -> StressFold:
        twin = self.twin
        log = Log.of(twin.model, capacity=max(1, len(events)))
        _, stale = log.extend(events, round(twin.config.time.max_delay * 1e9))
        truth = log.events.select(slice(None))
        untold = Log.resume(twin.model, None, without_truth(truth))
        return StressFold(self._folded(estimator, tuning, untold, None, prior), truth, stale)

    def _folded(
        self, estimator: str, tuning: Tuning, log: Log, base: Base | None, prior: Mapping[str, tuple[float, float]]
    ) -> Fold:
        twin = self.twin
        make = partial(Fold, estimator, twin.model, tuning, log, pairs=twin.pairs, policy=twin.policy)
        fold = make(base=base)
        if prior:
            fold = make(base=_wrong_prior(fold.base_at(0)[1], twin.model, prior))
        fold.advance()
        fold.finish()
        return fold


def _wrong_prior(base: Base, model: StateSpaceModel, prior: Mapping[str, tuple[float, float]]) -> Base:
    """Return the start of a fold whose prior is off, and too certain."""
    mean, cov = base.mean.copy(), base.cov.copy()
    for name, (sigmas, factor) in prior.items():
        j = model.state_names.index(name)
        mean[j] += sigmas * np.sqrt(cov[j, j])
        cov[j] *= factor
        cov[:, j] *= factor
    return base._replace(mean=mean, cov=cov, state=None)


def _share(word: float | None, length: int) -> float:
    """Which share of a length (ns) a word came after (s); infinite if it came later, or never."""
    share = np.inf if word is None else word * 1e9 / length
    return share if share < 1.0 else np.inf


SAME_EPISODE_NS = 1_000_000_000
"""ns between two episodes of one subject and cause that are the same, with a mistake and without."""


def green(fold: Fold) -> np.ndarray:
    """Return the rows whose health reports neither a wrong estimate nor a wrong band, (N,) of bool."""
    return np.isin(fold.track.health[: fold.n], USABLE)


def said_at(fold: Fold, episode: Episode) -> int:
    """When an episode was first heard of, ns of the log; its start is when it began, found in hindsight."""
    log, track, model = fold.log, fold.track, fold.model
    kind, channel = log.kind[: fold.n], log.channel[: fold.n]
    since = log.t[: fold.n] >= round(episode.start * 1e9)
    alarmed, health = track.alarms[: fold.n].any(axis=1), track.health[: fold.n]
    own = episode.subject.partition(".")[0]
    sensors = [
        k
        for k, sensor in enumerate(model.sensors)
        if own == sensor.name or episode.subject in (row.name for row in sensor.rows)
    ]
    flagged = track.flags[: fold.n] != 0
    if episode.cause in ("silent", "never heard", "outside"):
        heard = flagged
    elif sensors:
        heard = alarmed & (kind == READING) & (channel == sensors[0])
    else:
        heard = ~np.isin(health, (*USABLE, WAITING))
    rows = np.flatnonzero(heard & since)
    return int(log.t[rows[0]]) if rows.size else round(episode.start * 1e9)


def quiet_of(mistake: Mistake) -> tuple[int, ...]:
    """Return the health grades that are no detection: an advisory detects a fault, but is no false alarm."""
    return (TRACKING,) if mistake.causes else USABLE


def first_word(fold: Fold, start: int, calm: Fold | None = None, quiet: tuple[int, ...] = USABLE) -> float | None:
    """Seconds from `start` (ns) to the first row whose health is not `quiet`, once a reading has come; None without.

    Where `calm`, the fold without the mistake, had that health or a worse one at that time, the fault is not detected.
    """
    t, health = fold.events.t, fold.track.health[: fold.n]
    said = ~np.isin(health, (*quiet, WAITING)) & (t >= start)
    if calm is not None:
        # What holds at a time is what held before its events, and after each of them.
        before = np.maximum(np.searchsorted(calm.log.t[: calm.n], t, side="left") - 1, 0)
        after = np.searchsorted(calm.log.t[: calm.n], t, side="right")
        for grade in np.unique(health[said]):
            alike = np.concatenate(([0], np.cumsum(calm.track.health[: calm.n] >= grade)))
            said &= (health != grade) | (alike[after] == alike[before])
    rows = np.flatnonzero(said)
    return int(t[rows[0]] - start) / 1e9 if rows.size else None


def heard_in(fold: Fold, calm: Fold) -> list[tuple[int, Episode]]:
    """Episodes and when each was first heard of, ns of the log; not those that were heard of without the mistake."""
    known = [(said_at(calm, item), item) for item in episodes(calm)]
    return sorted(
        (
            (at, item)
            for at, item in ((said_at(fold, item), item) for item in episodes(fold))
            if not any(
                (item.subject, item.cause) == (other.subject, other.cause) and abs(at - when) < SAME_EPISODE_NS
                for when, other in known
            )
        ),
        key=lambda pair: pair[0],
    )


def accused(fold: Fold, episode: Episode, until: int) -> tuple[str, ...]:
    """Whom a user is told to look at: the most likely suspects where an episode leaves that open, else its subject.

    A sensor row by its name alone, an input or a parameter after that word. The question is asked at `until`, ns of the
    log; later events are not known yet.
    """
    if not isolates(episode.cause):
        return (episode.subject,)
    seen = fold.log.copy()
    seen.n = int(np.searchsorted(fold.events.t, until))
    try:
        _, base = fold.base_at(0)
        found = likeliest(suspects(fold.estimator.name, fold.model, fold.tuning, seen, episode.start, base=base))
    except NisusError:
        found = ()
    names: list[str] = []
    for kind, name in (item.nudge.target for item in found):
        names += name.split(SWAPPED) if kind == SWAP else [name if kind == SENSOR else f"{kind} {name}"]
    return tuple(names) or (episode.subject,)


def green_share(fold: Fold, start: int, end: int) -> float:
    """Share of green rows in [start, end), ns of the log."""
    t = fold.events.t
    during = (t >= start) & (t < end)
    return float(green(fold)[during].mean()) if during.any() else np.nan


def recovery(fold: Fold, end: int) -> float | None:
    """Seconds from `end` (ns) until the twin is green for good; None if it is not at the end of the log."""
    t, ok = fold.events.t, green(fold)
    after = np.flatnonzero(t >= end)
    if not after.size:
        return None
    wrong = after[~ok[after]]
    if not wrong.size:
        return 0.0
    if wrong[-1] == fold.n - 1:
        return None
    return int(t[wrong[-1] + 1] - end) / 1e9
