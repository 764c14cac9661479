"""What is guarded: recordings, each with its twin as the accepted tuning version has it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from config.files import shown_path
from config.guard_schema import FigureSection, ReferenceSection
from config.loader import find, shipped
from config.source_schema import SimulatorSection
from config.tuning_schema import AcceptedSection
from config.tunings import OWN, Version, accepted_version, folders, named, ships
from estimators.errors import ConfigError, NisusError, SourceError
from estimators.fold import Fold
from estimators.log import Log
from estimators.registry import find_entry
from estimators.snapshots import Base
from estimators.tuning import Tuning

from ...live.tunings.versions import COVERAGE, RMSE, now
from ...twin.log_reader import read_log
from ...twin.twin import Twin, load_twin, restore_twin
from ...views.recording.reader import read_recording
from ..compare import draws, tidy
from .baseline import Guarded, read_reference, write_reference
from .figures import allowances, fingerprint, judge, measured

LOGS = 3
"""Logs of a simulated asset, with consecutive seeds."""

SEEDS, SEEDS_EACH = 8, 4
"""Folds of a log by a filter that draws, with other seeds; the second of each of several logs."""

GUARD = ".guard.yaml"
"""The end of the name of a file of recorded scores."""


@dataclass(frozen=True)
class Archived:
    """One recording that is guarded: a twin with the log of its own source, or of a recording.

    `reference` is the file of its recorded scores, `writes` where they are written, which may hide it; `failure` says
    why a recording cannot be read, which is no reason to leave out the others of its folder.
    """

    name: str
    twin: Path
    recording: Path | None
    reference: Path
    writes: Path
    failure: str = ""

    @property
    def version(self) -> Version | None:
        """The version that it is folded with; None for what the twin's file says."""
        return accepted_version(self.twin)


def of_twin(name: str) -> Archived:
    """A twin with the log of its source.

    The scores of one that ships are with the program, but beside the versions of a user who has accepted one of them;
    those of any other beside its file.
    """
    twin = find(name)
    if not ships(twin):
        beside = twin.with_name(f"{twin.stem}{GUARD}")
        return Archived(twin.stem, twin, None, beside, beside)
    program = twin.parent.parent / "guard" / f"{twin.stem}.yaml"
    own = folders(twin)[0]
    version = accepted_version(twin)
    if version is None or version.path.parent != own:
        return Archived(twin.stem, twin, None, program, program)
    beside = own.parent.parent / "guard" / f"{twin.stem}.yaml"
    return Archived(twin.stem, twin, None, beside if beside.is_file() else program, beside)


def of_folder(folder: Path) -> list[Archived]:
    """The twins and the recordings of a folder.

    Raises:
        ConfigError: If there are none.
    """
    twins = [of_twin(str(path)) for path in sorted(folder.glob("*.yaml")) if not path.name.endswith(GUARD)]
    found = [_of_recording(path) for path in sorted(folder.glob("*.rrd"))]
    if not twins and not found:
        raise ConfigError(f"--archive {folder}: holds no recording (.rrd) and no twin (.yaml); name their folder")
    return twins + found


def _of_recording(path: Path) -> Archived:
    beside = path.with_name(f"{path.stem}{GUARD}")
    try:
        twin = read_recording(path).twin_path
    except SourceError as error:
        return Archived(path.stem, path, path, beside, beside, str(error))
    return Archived(path.stem, twin, path, beside, beside)


def chosen(names: Sequence[str], folder: Path | None) -> list[Archived]:
    """What the command line means: the twins that it names, a folder, or all that ship and have recorded scores."""
    found = [of_twin(name) for name in names]
    if folder is not None:
        found += of_folder(folder)
    return found or [archived for archived in map(of_twin, shipped()) if archived.reference.is_file()]


def twin_of(archived: Archived, overrides: dict[str, str] | None = None) -> Twin:
    """The twin as its accepted version has it; of a recording whose twin is gone, as the recording has it."""
    version = archived.version
    given = {**(overrides or {}), "tuning": OWN if version is None else str(version.path)}
    if archived.recording is None:
        return load_twin(archived.twin, overrides=given)
    recorded = read_recording(archived.recording)
    own = {key: value for key, value in recorded.overrides.items() if key != "tuning"}
    if archived.twin.is_file():
        return load_twin(archived.twin, overrides={**own, **given})
    return restore_twin(recorded.text, recorded.twin_path, own)


def is_simulated(archived: Archived, twin: Twin) -> bool:
    """Whether its logs are drawn anew each time."""
    return archived.recording is None and isinstance(twin.config.source, SimulatorSection)


def folds_of(archived: Archived, twin: Twin) -> tuple[int, int]:
    """How many logs there are, and how many folds of each."""
    logs = LOGS if is_simulated(archived, twin) else 1
    if not draws(find_entry(twin.estimator)):
        return logs, 1
    return logs, SEEDS if logs == 1 else SEEDS_EACH


def logs_of(archived: Archived, twin: Twin, span: float | None) -> Iterator[tuple[Log, Base | None]]:
    """Each log, and where its folds start.

    Args:
        archived: The recording.
        twin: See `twin_of`.
        span: Seconds of it that are folded; None for all.

    Raises:
        SourceError: If it is not there, or cannot be read.
    """
    if archived.recording is not None:
        recorded = read_recording(archived.recording)
        log = Log.resume(twin.model, recorded.base, recorded.events)
        _cut(log, span)
        yield log, recorded.base
        return
    source = twin.config.source
    if not isinstance(source, SimulatorSection):
        yield read_log(twin, span)[0], None
        return
    for k in range(LOGS):
        yield read_log(twin_of(archived, {"source.seed": str(source.seed + k)}), span)[0], None


def _cut(log: Log, span: float | None) -> None:
    if span is not None and log.n:
        log.n = int(np.searchsorted(log.t[: log.n], log.t[0] + round(span * 1e9), side="right"))


BUDGET = 15.0
"""Seconds of one processor for all folds of a recording; of one that would take longer a shorter span is guarded."""

FIRST = 10.0
"""Seconds of the first part of a recording that is timed."""


@dataclass(frozen=True)
class Wanted:
    """What is asked for: to record scores with a note, or None to compare; `overrides` are of the twins' YAML."""

    note: str | None = None
    overrides: Mapping[str, str] | None = None


def guarded(archived: Archived, wanted: Wanted) -> Guarded:
    """Fold a recording, compare it with its recorded scores, and record them if that is asked for."""
    begun = time.monotonic()
    found = Guarded(archived.name)
    try:
        if archived.failure:
            raise SourceError(archived.failure)
        twin = twin_of(archived, dict(wanted.overrides or {}))
        found = replace(found, version=twin.tuning.name)
        known = read_reference(archived.reference)
        if known is None and wanted.note is None:
            text = f"no scores are recorded; `nisus guard {_called(archived)} --accept --note ...` records them"
            return replace(found, absent=text)
        span = known.span if known is not None else _span(archived, twin)
        measures = measure(archived, twin, span, wanted.note)
        if wanted.note is not None:
            write_reference(archived.writes, archived.name, measures)
        if known is not None:
            found = replace(found, judged=judge(known, measures, simulated=is_simulated(archived, twin)))
    except SourceError as error:
        here = "is not there" in str(error)
        found = replace(found, absent=str(error) if here else "", failure="" if here else str(error))
    except NisusError as error:
        found = replace(found, failure=str(error))
    return replace(found, seconds=time.monotonic() - begun)


def measure(archived: Archived, twin: Twin, span: float | None, note: str | None) -> ReferenceSection:
    """All figures of a recording.

    Args:
        archived: The recording.
        twin: As it is folded.
        span: Seconds that are folded; None for all.
        note: Why they are recorded; None if they are not, and what is allowed of them is not asked for.

    Raises:
        NisusError: If it cannot be folded.
    """
    logs, values, allowed = [], [], []
    _, seeds = folds_of(archived, twin)
    for log, base in logs_of(archived, twin, span):
        logs.append(fingerprint(log))
        for seed in range(seeds):
            folds = _folds(twin, log, base, seed)
            values.append(_together(folds, measured))
            allowed.append(_together(folds, allowances) if note is not None else dict.fromkeys(values[-1], 0.0))
    return ReferenceSection(
        accepted=AcceptedSection(at=now(), note=note or ""),
        version=twin.tuning.name,
        estimator=twin.estimator,
        seeds=seeds,
        span=span,
        events=tuple(count for count, _ in logs),
        sums=tuple(total for _, total in logs),
        # What one of the logs does not tell is no figure of all.
        figures={
            name: FigureSection(
                values=tuple(each[name] for each in values), allowed=tuple(each[name] for each in allowed)
            )
            for name in values[0]
            if all(name in each for each in values)
        },
    )


def _folds(twin: Twin, log: Log, base: Base | None, seed: int) -> list[Fold]:
    """That of a log; where nothing is known to compare with, also with each sensor in turn held out and predicted."""
    found = [_folded(twin, twin.tuning, log, base, seed)]
    if any(name.startswith(f"{RMSE}.") for name in measured(found[0])):
        return found
    names = [twin.model.sensor_names[k] for k in twin.plan.fed]
    without = [twin.tuning.set(f"use.{name}", False) for name in names if len(names) > 1]
    return found + [_folded(twin, tuning, log, base, seed) for tuning in without]


def _together(folds: Sequence[Fold], figures: Callable[[Fold], dict[str, float]]) -> dict[str, float]:
    """The figures of the first fold, and the errors of the sensors that the others hold out."""
    first, *others = map(figures, folds)
    kinds = (f"{RMSE}.", f"{COVERAGE}.")
    return first | {name: value for each in others for name, value in each.items() if name.startswith(kinds)}


def _folded(twin: Twin, tuning: Tuning, log: Log, base: Base | None, seed: int) -> Fold:
    fold = _fold(twin, tuning, log, base, seed)
    fold.advance()
    fold.finish()
    if fold.failure is not None:
        raise fold.failure
    return fold


def _fold(twin: Twin, tuning: Tuning, log: Log, base: Base | None, seed: int) -> Fold:
    return Fold(
        twin.estimator,
        twin.model,
        replace(tuning, seed=seed),
        log,
        base=base,
        policy=twin.policy,
        expected=twin.expected,
    )


def _span(archived: Archived, twin: Twin) -> float | None:
    """Seconds of a recording that can be simulated, and folded as often as it is, within the budget; None for all.

    Of longer and longer parts, as all of a large asset would take much longer than that.
    """
    logs, seeds = folds_of(archived, twin)
    part = FIRST
    while True:
        begun = time.process_time()
        log, base = next(logs_of(archived, twin, part))
        # To read a recording takes as long for any part of it.
        read = time.process_time() - begun if is_simulated(archived, twin) else 0.0
        fold = _fold(twin, twin.tuning, log, base, 0)
        # The first call loads what is compiled.
        fold.advance(1)
        begun = time.process_time()
        fold.advance()
        needed = logs * (read + seeds * (time.process_time() - begun))
        seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9
        if needed > BUDGET:
            return tidy(seconds * BUDGET / needed)
        if seconds < 0.5 * part:
            return None
        part *= 4.0


def _called(archived: Archived) -> str:
    """What is guarded, as the command line takes it."""
    return named(archived.twin) if archived.recording is None else f"--archive {shown_path(archived.recording.parent)}"
