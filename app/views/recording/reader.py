"""A recording read back: twin, tuning and log as they were at the end, from which the track follows to the bit.

A recorder writes events again from the index where a late reading belongs. So rows are taken in the order of the file,
and an index that is not new cuts off what came after it.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from config.tunings import Version
from estimators.errors import SourceError
from estimators.log import Events
from estimators.snapshots import Base

from .format import FORMAT, PREFIX, READABLE, TIMELINE, base_from_json, version_from_json
from .rrd_file import BEGIN, MESSAGE_HEADER, STREAM_HEADER, whole_until


@dataclass(frozen=True)
class Recorded:
    """What a recording holds: twin, the last tuning, the log as it was at the end, lines (t, level, text).

    `text` is the twin's YAML, `version` the tuning version that it ran with, `overrides` what the command line changed,
    which older recordings do not tell.
    A fold of `events` starts at `base` (None: the prior). `first` is the index of their first event in the session,
    `rows` how many there are, and `closed` whether the recording was finished when it ended.
    """

    path: Path
    name: str
    text: str
    twin_path: Path
    overrides: Mapping[str, str]
    version: Version | None
    base: Base | None
    tuning: str
    tunings: int
    events: Events
    notices: list[tuple[int, str, str]]
    first: int
    rows: int
    closed: bool


def read_recording(path: Path) -> Recorded:
    """Read a recording back, also one whose writer was killed.

    Raises:
        SourceError: If it cannot be read, or is not a recording of Nisus.
    """
    if not path.is_file():
        raise SourceError(f"{path}: there is no such recording; check the path")
    content = _Content()
    try:
        content.read(path)
    except Exception:  # noqa: BLE001  Rerun's reader raises many kinds on a damaged file
        # Cut in the middle of a message, by a full disk or a power cut: what stands before it is whole.
        with tempfile.TemporaryDirectory() as folder:
            whole = Path(folder) / path.name
            content = _Content()
            try:
                copy_whole(path, whole)
                content.read(whole)
            except Exception as error:  # noqa: BLE001  as above
                if not (content.header and content.events):
                    text = _cut_short(path) or f"cannot be read ({_line(error, whole, path)}); is it an .rrd file?"
                    raise SourceError(f"{path}: {text}") from None
    header, tunings, notices = content.header, content.tunings, content.notices
    if not header or not tunings:
        text = _cut_short(path) or "holds no recording of Nisus; record one with `nisus run TWIN --record FILE.rrd`"
        raise SourceError(f"{path}: {text}")
    if int(header["format"]) not in READABLE:
        raise SourceError(f"{path}: has format {header['format']}, this version reads {FORMAT}; use the other")
    first, columns = _latest(content.events)
    base = base_from_json(content.bases[-1][1] if content.bases else str(header["base"]))
    start = content.bases[-1][0] if content.bases else first
    # What stands before the base belongs to a fold that the session had left behind.
    events = Events(*(_column(name, columns) for name in Events._fields)).select(slice(max(0, start - first), None))
    return Recorded(
        path=path,
        name=str(header["name"]),
        text=str(header["yaml"]),
        twin_path=Path(str(header["path"])),
        overrides=json.loads(str(header.get("overrides", "{}"))),
        version=version_from_json(str(header["version"])) if "version" in header else None,
        base=None if base is None else base._replace(first=start),
        tuning=str(tunings[-1]),
        tunings=len(tunings),
        events=events,
        notices=notices,
        first=start,
        rows=len(events),
        closed=finished(path),
    )


class _Content:
    """What the entities under /nisus hold, in the order of the file."""

    def __init__(self) -> None:
        self.header: dict[str, Any] = {}
        self.tunings: list[str] = []
        self.notices: list[tuple[int, str, str]] = []
        self.events: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
        self.bases: list[tuple[int, str]] = []

    def read(self, path: Path) -> None:
        with warnings.catch_warnings():
            # A killed writer leaves no footer; that such a file can still be read is the point.
            warnings.simplefilter("ignore")
            reader = RrdReader(str(path))
        for chunk in reader.stream():
            if not chunk.entity_path.startswith("/nisus/"):
                continue
            batch = chunk.to_record_batch()
            names = {name: k for k, name in enumerate(batch.schema.names)}
            if chunk.entity_path == "/nisus/twin":
                self.header = {name: _flat(batch.column(k))[0] for name, k in names.items() if not _control(name)}
            elif chunk.entity_path == "/nisus/notices":
                parts = (_flat(batch.column(names[name])).tolist() for name in ("t", "level", "text"))
                self.notices += zip(*parts, strict=True)
            elif chunk.entity_path == "/nisus/tuning":
                self.tunings += _flat(batch.column(names["json"])).tolist()
            elif chunk.entity_path == "/nisus/base":
                index = batch.column(names[TIMELINE]).to_pylist()
                self.bases += zip(index, _flat(batch.column(names["json"])).tolist(), strict=True)
            elif chunk.entity_path == "/nisus/events":
                index = batch.column(names[TIMELINE]).to_numpy()
                columns = {name: _flat(batch.column(k)) for name, k in names.items() if not _control(name)}
                self.events.append((index, columns))


def copy_whole(path: Path, to: Path) -> None:
    """Copy an .rrd up to the last message that is there in full."""
    with path.open("rb") as file:
        end, _ = whole_until(file, path.stat().st_size)
        file.seek(0)
        with to.open("wb") as copy:
            while end > 0 and (piece := file.read(min(end, 1 << 20))):
                copy.write(piece)
                end -= len(piece)


def finished(path: Path) -> bool:
    """Whether a recording was closed when it ended; one that was cut is read as far as it goes."""
    with path.open("rb") as file:
        return whole_until(file, path.stat().st_size)[1]


def _cut_short(path: Path) -> str | None:
    """What is missing of an .rrd that was not finished, and may be ours; None if it was, or is another program's."""
    size = path.stat().st_size
    with path.open("rb") as file:
        rerun = file.read(len(BEGIN)) == BEGIN
        file.seek(STREAM_HEADER)
        message = file.read(MESSAGE_HEADER.size)
        length = MESSAGE_HEADER.unpack(message)[1] if len(message) == MESSAGE_HEADER.size else size
        # The first message names the program; Rerun writes it in plain letters.
        name = file.read(min(length, size))
        _, whole = whole_until(file, size)
    if whole or not rerun:
        return None
    if len(name) < length:
        return f"is cut short: {size:,} bytes do not say what it records; look for another copy"
    if PREFIX.encode() not in name:
        return None
    return f"is a recording of Nisus, cut short before its first row: {size:,} bytes are there; look for another copy"


def _control(name: str) -> bool:
    return name == TIMELINE or name.startswith("rerun.") or name in ("log_time", "log_tick")


def _flat(column: Any) -> np.ndarray:
    return column.flatten().to_numpy(zero_copy_only=False)


def _line(error: Exception, copy: Path, path: Path) -> str:
    """What an error says, of the file itself where it says it of a copy."""
    text = str(error).strip()
    return text.splitlines()[0].replace(str(copy), path.name) if text else type(error).__name__


def _latest(chunks: list[tuple[np.ndarray, dict[str, np.ndarray]]]) -> tuple[int, dict[str, np.ndarray]]:
    """The rows that hold at the end: of each index the last one, and none that comes after an index written again."""
    if not chunks:
        return 0, {}
    index = np.concatenate([chunk for chunk, _ in chunks])
    # Columns of variances begin with the first reading that brought its own.
    names = dict.fromkeys(name for _, values in chunks for name in values)
    columns = {
        name: np.concatenate([values.get(name, np.full(rows.size, np.nan)) for rows, values in chunks])
        for name in names
    }
    # A row holds if no later row has an index that is not above its own.
    later = np.minimum.accumulate(index[::-1])[::-1]
    keep = np.append(index[:-1] < later[1:], True)
    kept = {name: column[keep] for name, column in columns.items()}
    return int(index[keep][0]), kept


def _column(name: str, columns: dict[str, np.ndarray]) -> np.ndarray:
    if name in columns:
        return columns[name]
    wide = list(_numbered(name, columns))
    rows = len(next(iter(columns.values()))) if columns else 0
    return np.stack(wide, axis=1) if wide else np.zeros((rows, 0))


def _numbered(name: str, columns: dict[str, np.ndarray]) -> Iterator[np.ndarray]:
    k = 0
    while f"{name}_{k}" in columns:
        yield columns[f"{name}_{k}"]
        k += 1


@dataclass(frozen=True)
class Facts:
    """Twin, filter, seconds from the first event to the last, and what it was worth (see summary.py), if it says so."""

    twin: str
    estimator: str | None
    seconds: float
    summary: dict[str, Any]


def facts_of(path: Path) -> Facts:
    """Look through a recording.

    Raises:
        SourceError: If it cannot be read, or is none of Nisus.
    """
    twin, estimator, summary = "", None, {}
    first, last = None, None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a killed writer leaves no footer
            reader = RrdReader(str(path))
        for chunk in reader.stream():
            part = chunk.entity_path.removeprefix("/nisus/")
            if part == chunk.entity_path or part not in ("twin", "tuning", "events", "summary"):
                continue
            batch = chunk.to_record_batch()
            names = {name: k for k, name in enumerate(batch.schema.names)}
            if part == "twin":
                twin = str(_values(batch, names["name"])[0])
            elif part == "tuning":
                estimator = json.loads(_values(batch, names["json"])[-1])["estimator"]
            elif part == "summary":
                summary = json.loads(_values(batch, names["json"])[-1])
            else:
                t = _values(batch, names["t"])
                # A late reading makes a recorder write events again, so they are not in the order of time.
                first = int(t.min()) if first is None else min(first, int(t.min()))
                last = int(t.max()) if last is None else max(last, int(t.max()))
    except Exception as error:  # noqa: BLE001  whatever Rerun raises of a file that is none
        if not twin:
            raise SourceError(f"{path.name}: it cannot be read; is it an .rrd file?") from error
    if not twin:
        raise SourceError(f"{path.name}: it is no recording of Nisus")
    return Facts(twin, estimator, 0.0 if first is None or last is None else (last - first) * 1e-9, summary)


def _values(batch: Any, k: int) -> Any:
    return batch.column(k).flatten().to_numpy(zero_copy_only=False)
