"""What the program knows of one type of source: how its section is checked, and how it is opened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from config.loader import Loaded
from config.yaml_lines import Key, dotted
from estimators.errors import SourceError
from estimators.model.state_space import StateSpaceModel
from sources.pieces import VALUES

from ..channels import channels
from ..files import find_recording

if TYPE_CHECKING:
    from sources.source import Channel, Report, Source

T = TypeVar("T")


@dataclass(frozen=True)
class Opening:
    """A section that is to be opened: its twin, its place in the YAML, and for what.

    `live` False takes a recording in place of a bus; `log_files` are recordings in place of its own.
    """

    loaded: Loaded
    model: StateSpaceModel
    section: Any
    key: Key
    report: Report
    live: bool = True
    log_files: Sequence[Path] | None = None


@dataclass(frozen=True)
class Kind:
    """One type of source.

    Args:
        open: Opens it.
        check: Checks its section against the model beyond its channels, before any file is touched.
        sections: The sections whose channels feed the model, each with its key: itself, unless it has parts or none.
        takes_log: Whether `--log` can replace what it reads.
        kernels: What it compiles; see `sources/pieces.py`.
        files: Opens its files alone, as `open` does: what is wrong with them is told before anything is compiled.
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
            raise about(loaded, key, reason) from None
    for place, channel in named:
        try:
            build([channel])
        except SourceError as error:
            raise about(loaded, place, str(error).removeprefix(f"{channel.name}: ")) from None
    raise about(loaded, key, reason)


def recording(make: Callable[[Opening, list[Path], list[Channel]], Source]) -> Kind:
    """A type whose sections are recordings: `make(opening, files, channels)` gives the source.

    Its section has `folder`, `files` and `get` (config/source_schema.py, RecordingSection) beside maps of channels.
    """

    def open_recording(opening: Opening) -> Source:
        files = find_recording(opening.loaded, opening.section, opening.key, opening.log_files)
        return blamed(opening, lambda channels: make(opening, files, channels))

    return Kind(open_recording, kernels=(VALUES,), files=closed(open_recording))


def closed(open_: Callable[[Opening], Source]) -> Callable[[Opening], None]:
    """Opens a recording, and closes it again."""
    return lambda opening: open_(opening).close()


def about(loaded: Loaded, key: Key, text: str) -> SourceError:
    """What a source says of itself, with the place in the YAML that it concerns."""
    return SourceError(f"{loaded.places.at(key)}: {dotted(key)}: {text}")
