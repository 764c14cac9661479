"""One mistake made with one filter over one log: what was said of it, and what the estimate was worth meanwhile."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from config.source_schema import AssetSection, CanSection
from estimators.diagnostics.episodes import episodes
from estimators.diagnostics.score import Score, score
from estimators.errors import SourceError
from estimators.fold import Fold
from estimators.log import MARK, TICK, TRUTH, Events, Log
from estimators.tuning import Tuning
from sources.faults.layer import Faults
from sources.faults.source import with_faults
from sources.memory import MemorySource
from sources.simulation.simulator import Simulator

from ..twin.sources.asset import make_asset
from ..twin.twin import Twin
from .mistake import Mistake
from .told import first_word, green_share, recovery, said_at

GATE = 0.9973
"""Of the fold with the defence, where the twin ships without a gate."""


@dataclass(frozen=True)
class Trial:
    """What came of one mistake.

    `delay`: seconds from its start to the first episode with its cause and one of its subjects; `word`: to the first
    row that is not green; None is never. `named`: the first episode after the start, subject and cause. `early`:
    episodes that were heard of before it began. `green`: share of green rows while it lasted. `error` and `bare`: RMSE
    by state over the truth meanwhile, with a gate and without; `calm`: of the same filter over the same time, without
    the mistake; `coverage`: share of the truth in the 95 % band, by state. `recovery`: seconds from its end until green
    for good; None is never, or that it does not end.
    """

    mistake: str
    estimator: str
    seed: int
    start: float
    end: float
    delay: float | None
    word: float | None
    named: str | None
    cause_right: bool
    subject_right: bool
    early: int
    green: float
    error: dict[str, float]
    bare: dict[str, float]
    calm: dict[str, float]
    coverage: dict[str, float]
    recovery: float | None
    stale: int


class Folded(NamedTuple):
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
    """What the twin's source says in `duration` seconds, without stamps; of an asset with another seed.

    Raises:
        SourceError: If the source cannot be opened, or says nothing.
    """
    asset = asset_of(twin, seed)
    source = with_faults(asset, twin.faults()) if asset is not None else twin.open_source(_ignore, live=False)
    return _read(source, twin.model.width, duration)


def _ignore(key: str, text: str) -> None:
    """Nobody listens."""


def _read(source: object, width: int, duration: float) -> Events:
    parts: list[Events] = []
    begin: int | None = None
    try:
        while (batch := source.read(1.0)) is not None:  # type: ignore[attr-defined]
            if not len(batch):
                continue
            begin = int(batch.t[0]) if begin is None else begin
            parts.append(batch)
            if batch.t[-1] - begin > duration * 1e9:
                break
    finally:
        source.close()  # type: ignore[attr-defined]
    if begin is None:
        raise SourceError("stress: the source said nothing")
    events = Events.concat(parts, width)
    return events.select((events.kind != MARK) & (events.t <= begin + round(duration * 1e9)))


class Bench:
    """A twin's log, made once, and the folds that a mistake is compared with.

    Args:
        twin: As it ships.
        seed: Of the asset, the faults and the filter.
        duration: Seconds of the log.

    A fault of the source lasts from a third to two thirds of the log; an error of the belief from its start on. What
    the twin says, it says without having been told the truth; that is for the scores alone.
    """

    def __init__(self, twin: Twin, seed: int, duration: float) -> None:
        self.twin, self.seed, self.duration = twin, seed, duration
        self.events = plain_log(twin, seed, duration)
        self.origin = int(self.events.t[0])
        self.length = float(self.events.t.max() - self.events.t[0]) * 1e-9
        self._calm: dict[str, Folded] = {}

    def window(self, mistake: Mistake) -> tuple[float, float]:
        """When a mistake lasts, seconds after the log's first event."""
        third = round(self.length / 3.0, 3)
        return (0.0, self.length) if mistake.fault is None else (third, 2.0 * third)

    def run(self, mistake: Mistake, estimator: str) -> Trial:
        """Make a mistake with a filter.

        Raises:
            NisusError: If the filter does not apply, or the mistake cannot be made.
        """
        start, end = self.window(mistake)
        events = self._damaged(mistake, start, end)
        tuning = self._tuning(estimator, mistake)
        gated = self._fold(estimator, tuning.set("gate", self.twin.tuning.gate or GATE), events)
        bare = self._fold(estimator, tuning.set("gate", None), events)
        ships = gated if self.twin.tuning.gate is not None else bare
        shipped = ships.fold
        begun, ended = self.origin + round(start * 1e9), self.origin + round(end * 1e9)
        told = sorted(((said_at(shipped, item), item) for item in episodes(shipped)), key=lambda pair: pair[0])
        since = [(at, item) for at, item in told if at >= begun]
        after = [(at, item) for at, item in since if at < ended]
        fits = [at for at, item in after if mistake.right_cause(item) and mistake.right_subject(item)]
        first = after[0][1] if after else None
        scores = {name: self._score(item, begun, ended) for name, item in (("gated", gated), ("bare", bare))}
        calm = self._score(self._undisturbed(estimator), begun, ended)
        return Trial(
            mistake=mistake.name,
            estimator=estimator,
            seed=self.seed,
            start=start,
            end=end,
            delay=(fits[0] - begun) / 1e9 if fits else None,
            word=first_word(shipped, begun),
            named=f"{first.subject} {first.cause}" if first is not None else None,
            cause_right=first is not None and mistake.right_cause(first),
            subject_right=first is not None and mistake.right_subject(first),
            early=len(told) - len(since),
            green=green_share(shipped, begun, ended),
            error={name: fit.rmse for name, fit in scores["gated"].states.items()},
            bare={name: fit.rmse for name, fit in scores["bare"].states.items()},
            calm={name: fit.rmse for name, fit in calm.states.items()},
            coverage={name: fit.coverage for name, fit in scores["gated" if ships is gated else "bare"].states.items()},
            recovery=None if mistake.fault is None else recovery(shipped, ended),
            stale=ships.stale,
        )

    def _damaged(self, mistake: Mistake, start: float, end: float) -> Events:
        """The log as it becomes; a change of the asset needs a run of its own."""
        if mistake.fault is None:
            return self.events
        faults = mistake.fault(start, end)
        if not mistake.of_asset:
            layer = Faults(self.twin.model, faults, seed=self.seed)
            return _everything(with_faults(MemorySource(self.events), layer), self.twin.model.width)
        asset = asset_of(self.twin, self.seed)
        if asset is None:
            raise SourceError(f"{mistake.name}: {self.twin.name} has no simulated asset")
        layer = Faults(self.twin.model, [*self.twin.plan.scheduled, *faults], seed=self.seed)
        layer.attach(asset)
        return _read(with_faults(asset, layer), self.twin.model.width, self.duration)

    def _tuning(self, estimator: str, mistake: Mistake) -> Tuning:
        tuning = replace(self.twin.tuning.with_options(self.twin.options_of(estimator)), seed=self.seed)
        for key, factor in mistake.belief.items():
            tuning = tuning.set(key, factor * float(tuning.get(key) or 0.0))
        return tuning

    def _fold(self, estimator: str, tuning: Tuning, events: Events) -> Folded:
        twin = self.twin
        log = Log.of(twin.model, capacity=max(1, len(events)))
        _, stale = log.extend(events, round(twin.config.time.horizon * 1e9))
        truth = log.events.select(slice(None))
        untold = Log.of(twin.model, capacity=max(1, len(truth)))
        untold.extend(without_truth(truth))
        fold = Fold(estimator, twin.model, tuning, untold, pairs=twin.pairs, policy=twin.policy)
        fold.advance()
        fold.finish()
        return Folded(fold, truth, stale)

    def _undisturbed(self, estimator: str) -> Folded:
        if estimator not in self._calm:
            tuning = replace(self.twin.tuning.with_options(self.twin.options_of(estimator)), seed=self.seed)
            self._calm[estimator] = self._fold(estimator, tuning, self.events)
        return self._calm[estimator]

    def _score(self, folded: Folded, start: int, end: int) -> Score:
        t = folded.truth.t
        rows = (t >= start) & (t <= end)
        return score(
            folded.fold.track.select(slice(0, t.size)).select(rows), folded.truth.select(rows), self.twin.model
        )


def _everything(source: object, width: int) -> Events:
    """All that a source gives, stamps included."""
    parts = []
    while (batch := source.read(0.0)) is not None:  # type: ignore[attr-defined]
        parts.append(batch)
    return Events.concat(parts, width)
