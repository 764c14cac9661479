"""Interface of source types: how a section is checked and opened, and where its files are."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import platformdirs

from config.loader import Loaded, shown_path
from config.source_schema import CanLogSection, CanSection, RecordingSection, TableSection
from config.yaml_files import Key, dotted
from estimators.errors import NisusError, SourceError
from estimators.log import READING
from estimators.model.state_space import Sensor, StateSpaceModel
from sources.formats import check_once, files_of, is_file, is_whole, suffix_of, tables

from ..channels import channel_of, channels

if TYPE_CHECKING:
    from sources.source import Channel, Report, Source

T = TypeVar("T")


@dataclass(frozen=True)
class Opening:
    """A section that is to be opened: its twin, its place in the YAML, and for what.

    `live` False takes a recording in place of a bus; `log_files` are recordings in place of its own. With
    `of_assets` it is that of a fleet: `assets` are its own, if they are named; with `stored` its state is kept.
    """

    loaded: Loaded
    model: StateSpaceModel
    section: Any
    key: Key
    report: Report
    live: bool = True
    log_files: Sequence[Path] | None = None
    of_assets: bool = False
    assets: tuple[str, ...] = ()
    stored: bool = False


@dataclass(frozen=True)
class Kind:
    """One type of source.

    Args:
        open: Opens it.
        check: Checks its section against the model beyond its channels, before any file is touched.
        sections: The sections whose channels feed the model, each with its key: itself, unless it has parts or none.
        takes_log: Whether `--log` can replace what it reads.
        kernels: Its compiled functions; see `sources/pieces.py`.
        files: Opens its files only, so that errors in them are reported before anything is compiled.
    """

    open: Callable[[Opening], Source]
    check: Callable[[Loaded, StateSpaceModel, Any, Key], None] = lambda *_: None
    sections: Callable[[Any, Key], dict[Key, Any]] = lambda section, key: {key: section}
    takes_log: bool = True
    kernels: tuple[str, ...] = ()
    files: Callable[[Opening], object] = lambda _: None


def blamed(opening: Opening, build: Callable[[list[Channel]], T]) -> T:
    """Build with every channel of the section; if that fails, find the one at fault and name its line.

    Raises:
        SourceError: With file and line.
    """
    loaded, key = opening.loaded, opening.key
    named = channels(loaded, opening.section, key, opening.model)
    try:
        return build([channel for _, channel in named])
    except SourceError as error:
        reason = str(error)
    try:
        build([])
    except SourceError as error:
        if str(error) == reason:  # No channel's fault: a file, or the column that holds the time.
            raise failure(loaded, key, reason, ": ") from None
    for place, channel in named:
        try:
            build([channel])
        except SourceError as error:
            text = str(error).removeprefix(f"{channel.name}: ")
            raise failure(loaded, place, text, ": ") from None
    raise failure(loaded, key, reason, ": ")


def closed(open_: Callable[[Opening], Source]) -> Callable[[Opening], None]:
    """Opens a recording, and closes it again."""
    return lambda opening: open_(opening).close()


DATA = "NISUS_DATA"
"""Environment variable that replaces the `folder` of every recording."""


def find_recording(
    loaded: Loaded, section: CanSection | RecordingSection, key: Key, log_files: Sequence[Path] | None
) -> list[Path]:
    """Return the files of a recording, in order; `log_files`, from the command line, replace them.

    Raises:
        SourceError: If one is absent, with where it was sought and how to get it.
    """
    if log_files is not None:
        files = [file for given in log_files for file in files_of(given.expanduser())]
        for file in files:
            if not is_file(file) and not file.exists():
                raise SourceError(f"--log {file}: there is no such file; check the path")
            if not is_file(file):
                raise SourceError(f"--log {file}: it is a device or a pipe; name a file, which can be read again")
        check_once(files, "--log ")
        return files
    if isinstance(section, RecordingSection):
        patterns, where = section.files, (*key, "files")
    elif section.recording is not None:
        patterns, where = section.recording, (*key, "recording")
    else:
        raise failure(loaded, key, "is a live bus, which does not end; give a recording of it with --log FILE")
    found: list[Path] = []
    for pattern in patterns:
        matches = matching(loaded, section, pattern)
        if not matches:
            raise _absent(loaded, where, _root(loaded, section) / Path(pattern).expanduser(), section)
        found += [file for match in matches for file in files_of(match)]
    check_once(found, f"{loaded.places.at(where)}: {dotted(where)}: ")
    return found


def matching(loaded: Loaded, section: CanSection | RecordingSection, pattern: str) -> list[Path]:
    """Return the present files of a pattern by name; of a followed folder all files whose name is that of a table."""
    root = _root(loaded, section)
    wanted = str(Path(pattern).expanduser())
    exact = root / wanted  # A name with brackets in it is itself before it is a pattern.
    followed = isinstance(section, TableSection) and section.follow
    if _is_recording(exact) or (exact.is_dir() and not followed):
        return [exact]
    if exact.is_dir():
        files = [path for path in exact.iterdir() if path.is_file() and suffix_of(path) in tables()]
        return sorted(path for path in files if not path.name.startswith("."))
    escaped = wanted if os.path.isabs(wanted) else os.path.join(glob.escape(str(root)), wanted)
    return sorted(Path(match) for match in glob.glob(escaped, recursive=True) if _is_recording(Path(match)))


def _is_recording(path: Path) -> bool:
    """Return whether it is a file, or a folder that is one."""
    return is_file(path) or is_whole(path)


def find_databases(
    loaded: Loaded, section: CanSection | CanLogSection, key: Key
) -> list[tuple[Path, int | str | None]]:
    """Return the DBC files with the buses on which they hold; sought in the recording's folder, then beside the YAML.

    Raises:
        SourceError: If one is absent.
    """
    found: list[tuple[Path, int | str | None]] = []
    for item in section.dbc:
        name = Path(item.file).expanduser()
        tried = [Path(os.path.normpath(_root(loaded, section) / name)), _beside(loaded, name)]
        path = next((path for path in tried if path.is_file()), None)
        if path is None:
            raise _absent(loaded, (*key, "dbc"), tried[0], section)
        found.append((path, item.channel))
    return found


def signal_ends(sensor: Sensor, loaded: Loaded) -> tuple[tuple[float, ...], ...]:
    """Return the two ends of each row's signal by the DBC, in the model's units; nothing without one.

    A channel or DBC at fault has none: it is reported where the source is planned or opened.
    """
    source = loaded.config.source
    for part in getattr(source, "parts", (source,)):
        if isinstance(part, CanSection | CanLogSection) and sensor.name in part.sensors:
            with suppress(NisusError):
                from sources.can.decoder import ends_of

                rows = [(row.name, row.unit) for row in sensor.rows]
                channel = channel_of(loaded, (), part.sensors[sensor.name], READING, 0, sensor.name, rows)
                return ends_of(find_databases(loaded, part, ()), channel)
    return ()


def failure(loaded: Loaded, key: Key, text: str, joint: str = " ") -> SourceError:
    """Return an error of the source about the value at `key`, after which `joint` stands."""
    return SourceError(f"{loaded.places.at(key)}: {dotted(key)}{joint}{text}")


def _beside(loaded: Loaded, path: Path) -> Path:
    return Path(os.path.normpath(loaded.path.absolute().parent / path))


def recordings_folder() -> Path:
    """Return the folder of recordings that belong to no YAML: NISUS_DATA, or one in the user's cache."""
    return Path(os.environ.get(DATA) or platformdirs.user_cache_path("nisus") / "recordings")


def _root(loaded: Loaded, section: CanSection | RecordingSection) -> Path:
    """Return the folder of a recording: NISUS_DATA in place of `folder`, where the YAML gives one.

    A recording that others can `get` is in the user's cache if there is no such folder.
    """
    if not isinstance(section, RecordingSection) or section.folder is None:
        return _beside(loaded, Path())
    own = _beside(loaded, Path(section.folder).expanduser())
    return recordings_folder() if os.environ.get(DATA) or (section.get and not own.is_dir()) else own


def _absent(loaded: Loaded, key: Key, path: Path, section: CanSection | RecordingSection) -> SourceError:
    recording = section if isinstance(section, RecordingSection) else None
    remedies = []
    if recording is not None and recording.folder is not None:
        remedies.append(f"set {DATA} to the folder that holds the recordings")
    if key[-1] != "dbc":
        remedies.append("give other recordings with --log FILE")
    text = f"is not there: {shown_path(path)}; {' or '.join(remedies) or 'check the path'}"
    if recording is not None and recording.get:
        text += "; to get it: " + " ".join(recording.get.split())
    return failure(loaded, key, text)
