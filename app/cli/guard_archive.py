"""What is guarded: recordings, each with its twin as the accepted tuning version has it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from config.loader import find, shipped
from config.source_schema import SimulatorSection
from config.tunings import OWN, Version, accepted_version, folders, ships
from estimators.errors import ConfigError, SourceError
from estimators.log import Log
from estimators.registry import find_entry
from estimators.snapshots import Base

from ..twin.twin import Twin, load_twin, restore_twin
from ..views.recording.reader import read_recording
from .compare_fold import draws
from .fold import read_log

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
