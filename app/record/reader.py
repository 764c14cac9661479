"""Reading a recording back: twin, tuning and log as they were at its end, which give the track again, bit for bit.

A recorder writes events again from the index of a late measurement on. So rows are taken in the order of the file, and
an index that is not new cuts off the rows after it.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from config.tunings import Version
from estimators.errors import SourceError
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.snapshots import Base

from ..engine.fold_json import base_from_json, version_from_json
from ..engine.history_copy import last_written
from ..engine.notices import Annotation
from ..result import JsonObject
from .format import BORDERED, FORMAT, PREFIX, READABLE, TIMELINE
from .rrd_file import MAGIC, MESSAGE_HEADER, STREAM_HEADER, complete_until

SQUARE_ROOT = ("sr-ekf", "sr-kf", "sr-ukf")  # Filters whose factor with considered states changed


@dataclass(frozen=True)
class ReadRecording:
    """Content of a recording.

    `text` is the twin's YAML, `version` its tuning version, `overrides` the keys that the command line changed (older
    recordings have none). `tuning` is the last of `tunings`. A fold of `events` starts at `base` (None: the prior);
    `first` is the index of the first event in the session, `rows` their number. `notices` are (t, level, text),
    `annotations` the notes of users by time, and `closed` is whether the recording was finished when it ended.
    `format` is that of the file.
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
    annotations: list[Annotation]
    first: int
    rows: int
    closed: bool
    format: int = FORMAT

    def base_for(self, model: StateSpaceModel) -> tuple[Base | None, str]:
        """Return the start of a fold of `events`, and a remark if the filter's full state cannot be used there, or "".

        Square-root filters with considered states once stored another factor. The fold then starts from mean and
        covariance, which are right.
        """
        base = self.base
        if base is None or not model.considered or self.format >= BORDERED or base.estimator not in SQUARE_ROOT:
            return base, ""
        remark = (
            f"{self.path.name}: format {self.format} stored another factor of {base.estimator} with considered "
            "parameters; it is folded from the mean and covariance at its first event, detectors start anew"
        )
        return base._replace(estimator="", state=None, evidence=None, doubt=None), remark


def read_recording(path: Path) -> ReadRecording:
    """Read a recording, also one whose writer was killed.

    Raises:
        SourceError: If it cannot be read, or is not a recording of Nisus.
    """
    if not path.is_file():
        raise SourceError(f"{path}: there is no such recording; check the path")
    content = _Content()
    try:
        content.read(path)
    except Exception:  # noqa: BLE001  Rerun's reader raises many kinds on a damaged file
        # Cut in the middle of a message, by a full disk or a power failure: the messages before it can be read.
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / path.name
            content = _Content()
            try:
                copy_complete(path, copy)
                content.read(copy)
            except Exception as error:  # noqa: BLE001  as above
                if not (content.header and content.events):
                    text = (str(error).strip().splitlines() or [type(error).__name__])[0].replace(str(copy), path.name)
                    raise SourceError(f"{path}: {_truncated(path) or f'cannot be read ({text})'}") from None
    header, tunings = content.header, content.tunings
    if not header or not tunings:
        text = _truncated(path) or "holds no recording of Nisus; record one with `nisus run TWIN --record FILE.rrd`"
        raise SourceError(f"{path}: {text}")
    if int(header["format"]) not in READABLE:
        raise SourceError(f"{path}: has format {header['format']}, this version reads {FORMAT}; use the other")
    if not content.events:
        text = _truncated(path) or "holds no measurement, it was ended before the first; record for longer"
        raise SourceError(f"{path}: {text}")
    first, columns = _latest(content.events)
    base = base_from_json(content.bases[-1][1] if content.bases else str(header["base"]))
    start = content.bases[-1][0] if content.bases else first
    # Events before the base belong to an earlier fold of the session.
    events = Events(*(_column(name, columns) for name in Events._fields)).select(slice(max(0, start - first), None))
    return ReadRecording(
        path=path,
        name=str(header["name"]),
        text=str(header["yaml"]),
        twin_path=Path(str(header["path"])),
        overrides=json.loads(str(header.get("overrides", "{}"))),
        version=version_from_json(str(header["version"])) if "version" in header else None,
        base=None if base is None else base._replace(first=start),
        tuning=tunings[-1],
        tunings=len(tunings),
        events=events,
        notices=content.notices,
        annotations=[note for note in content.annotations.values() if note.text],
        first=start,
        rows=len(events),
        closed=finished(path),
        format=int(header["format"]),
    )


@dataclass(frozen=True)
class Facts:
    """Twin, filter, duration in seconds, and the summary of a recording, for lists of many."""

    twin: str
    estimator: str | None
    seconds: float
    summary: JsonObject


def facts_of(path: Path) -> Facts:
    """Return the facts of a recording, also of one that is being written.

    Raises:
        SourceError: If it cannot be read, or is not a recording of Nisus.
    """
    content = _Content()
    try:
        content.read(path)
    except Exception as error:  # noqa: BLE001  Rerun's reader raises many kinds
        if not content.header:
            raise SourceError(f"{path.name}: it cannot be read; is it an .rrd file?") from error
    if not content.header:
        raise SourceError(f"{path.name}: it is no recording of Nisus")
    # Not in the order of time: a late measurement makes a recorder write events again.
    times = [columns["t"] for _, columns in content.events]
    seconds = (max(int(t.max()) for t in times) - min(int(t.min()) for t in times)) * 1e-9 if times else 0.0
    estimator = json.loads(content.tunings[-1])["estimator"] if content.tunings else None
    return Facts(str(content.header["name"]), estimator, seconds, content.summary)


class _Content:
    """Entities under /nisus, in the order of the file."""

    def __init__(self) -> None:
        self.header: JsonObject = {}
        self.summary: JsonObject = {}
        self.tunings: list[str] = []
        self.notices: list[tuple[int, str, str]] = []
        self.annotations: dict[int, Annotation] = {}
        self.events: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
        self.bases: list[tuple[int, str]] = []

    def read(self, path: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a killed writer leaves no footer, and these files have none
            reader = RrdReader(str(path))
        for chunk in reader.stream():
            if not chunk.entity_path.startswith("/nisus/"):
                continue
            batch, part = chunk.to_record_batch(), chunk.entity_path.removeprefix("/nisus/")
            # Rows are lists; timelines and Rerun's own columns are not.
            columns = {
                name: column.flatten().to_numpy(zero_copy_only=False)
                for name, column in zip(batch.schema.names, batch.columns, strict=True)
                if hasattr(column, "flatten")
            }
            if part == "twin":
                # Written again when the twin's files are saved; one chunk may hold both, and the last row counts.
                last = {name: batch.column(name)[-1].as_py() for name in columns}
                self.header = {name: values[0] for name, values in last.items() if values}
            elif part == "summary":
                self.summary = json.loads(columns["json"][-1])
            elif part == "notices":
                self.notices += zip(*(columns[name].tolist() for name in ("t", "level", "text")), strict=True)
            elif part == "annotations":
                for number, t, text in zip(*(columns[name].tolist() for name in ("number", "t", "text")), strict=True):
                    self.annotations[number] = Annotation(number, t, text)
            elif part == "tuning":
                self.tunings += columns["json"].tolist()
            elif part in ("base", "events"):
                index = batch.column(batch.schema.names.index(TIMELINE)).to_numpy()
                if part == "base":
                    self.bases += zip(index.tolist(), columns["json"].tolist(), strict=True)
                else:
                    self.events.append((index, columns))


def copy_complete(path: Path, to: Path) -> None:
    """Copy an .rrd up to its last complete message."""
    with path.open("rb") as file:
        left, _ = complete_until(file, path.stat().st_size)
        file.seek(0)
        with to.open("wb") as copy:
            while left > 0 and (piece := file.read(min(left, 1 << 20))):
                copy.write(piece)
                left -= len(piece)


def finished(path: Path) -> bool:
    """Return whether a recording was closed when it ended."""
    with path.open("rb") as file:
        return complete_until(file, path.stat().st_size)[1]


def _truncated(path: Path) -> str | None:
    """Return the message about a truncated .rrd that may be ours; None if it is complete or another program's."""
    size = path.stat().st_size
    with path.open("rb") as file:
        is_rrd = file.read(len(MAGIC)) == MAGIC
        file.seek(STREAM_HEADER)
        message = file.read(MESSAGE_HEADER.size)
        length = MESSAGE_HEADER.unpack(message)[1] if len(message) == MESSAGE_HEADER.size else size
        name = file.read(min(length, size))  # the first message holds the program's name in plain letters
        _, closed = complete_until(file, size)
    if closed or not is_rrd:
        return None
    if len(name) < length:
        return f"is cut short: {size:,} bytes, too few to name its twin; look for another copy"
    if PREFIX.encode() not in name:
        return None
    return f"is a recording of Nisus, cut short before its first row: {size:,} bytes are there; look for another copy"


def _latest(chunks: list[tuple[np.ndarray, dict[str, np.ndarray]]]) -> tuple[int, dict[str, np.ndarray]]:
    """Return the first index and the columns of the rows that are valid at the end of the file."""
    index = np.concatenate([chunk for chunk, _ in chunks])
    # Columns of variances begin with the first measurement that has its own.
    names = dict.fromkeys(name for _, values in chunks for name in values)
    columns = {
        name: np.concatenate([values.get(name, np.full(rows.size, np.nan)) for rows, values in chunks])
        for name in names
    }
    keep = last_written(index)
    return int(index[keep][0]), {name: column[keep] for name, column in columns.items()}


def _column(name: str, columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return a column of the events; one of several values is stored as name_0, name_1, ..."""
    if name in columns:
        return columns[name]
    count = next(k for k in range(len(columns) + 1) if f"{name}_{k}" not in columns)
    rows = len(next(iter(columns.values())))
    return np.stack([columns[f"{name}_{k}"] for k in range(count)], axis=1) if count else np.zeros((rows, 0))
