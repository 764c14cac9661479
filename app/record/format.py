"""Format of recordings: an .rrd file that Rerun opens, with everything needed to fold it again, bit for bit.

Besides the charts, the file keeps plain columns under /nisus: `twin` (YAML, tuning version, overrides, base), `tuning`
(each with the event from which it applied), `events` (the log), `base` (start of a fold of them, if it has moved),
`notices`, `annotations` (notes of users; the last row of a number counts, one without text is a note that was deleted)
and `summary` (scores of the session, for lists). The track is not stored: log and tuning give it again. Rows
have absolute indices; after a late measurement the events are written again from its index on.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr

from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.score import Score, score
from estimators.errors import NisusError, SourceError
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.snapshots import Base
from estimators.track import Track
from estimators.tuning import Tuning

from ..columns import units_by_name
from ..engine.copies import Pull
from ..engine.fold_json import base_to_json, tuning_to_json, version_to_json
from ..engine.history_copy import copy_rows
from ..engine.notices import Annotation
from ..engine.running_fold import Running
from ..result import JsonObject, plain
from ..twin.twin import Twin
from .rrd_file import END_MESSAGE, MESSAGE_HEADER, STREAM_HEADER, TAKEN, messages

FORMAT = 3
READABLE = (1, 2, 3)  # Formats that can be read; the first also stored the track
BORDERED = 3  # Format from which square-root filters with considered states store a bordered factor
PREFIX = "nisus_"  # Start of the application id that Rerun shows; the name of the twin follows
TIMELINE = "event"
FLUSH_TIMEOUT_S = 5.0


class RecordingFile:
    """A recording that is being written, in a stream of its own, so that no viewer can delay it.

    Rerun's own file sink keeps an entry for each column of each chunk in memory, some kilobytes a chunk; it follows
    links and overwrites files; and it waits without a limit for a full disk. So the bytes are taken from the stream and
    written here. A viewer reads a file without Rerun's footer from its start.
    """

    def __init__(self, path: Path, twin: Twin, base: Base | None) -> None:
        """Create the file; its path must be free, also of a broken link.

        `base` is the start of the fold, if older events were dropped; None for the prior.

        Raises:
            SourceError: If the file cannot be written.
        """
        self.path, self.size = path, 0
        self.stream = rr.RecordingStream(f"{PREFIX}{twin.name}", recording_id=f"{twin.name}-{path.stem}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        except FileExistsError:
            raise SourceError(f"recording {path}: {TAKEN}") from None
        except OSError as error:
            raise SourceError(f"recording {path}: {error.strerror}; choose another folder") from None
        self._bytes = self.stream.binary_stream()
        self.rows = 0
        self._annotations: tuple[Annotation, ...] = ()
        self._changes = 0
        # The path is there for a model file beside it.
        self._header = {"name": twin.name, "path": str(twin.path), "base": base_to_json(base)}
        self.twin(twin)

    def twin(self, twin: Twin) -> None:
        """Write the twin's YAML, its overrides from the command line, and its tuning version; the last ones count."""
        more = {"yaml": twin.text, "overrides": json.dumps(dict(twin.overrides))}
        if twin.version is not None:
            more["version"] = version_to_json(twin.version)
        self.stream.log("/nisus/twin", rr.AnyValues(format=FORMAT, **self._header, **more), static=True)

    def base(self, base: Base | None, index: int, revision: int) -> None:
        """Write the start of a revision's fold from event `index` on; None is the prior."""
        self._send("base", TIMELINE, [index], json=[base_to_json(base)], revision=[revision])

    def tuning(self, tuning: Tuning, estimator: str, index: int, revision: int) -> None:
        """Write the tuning that applies from event `index` on."""
        self._send("tuning", TIMELINE, [index], json=[tuning_to_json(tuning, estimator)], revision=[revision])

    def _send(self, name: str, timeline: str, index: Sequence[int] | np.ndarray, **columns: object) -> None:
        """Write rows of an entity under /nisus with these columns, at these indices of a timeline."""
        indexes = [rr.TimeColumn(timeline, sequence=index)]
        self.stream.send_columns(f"/nisus/{name}", indexes=indexes, columns=rr.AnyValues.columns(**columns))

    def summary(self, found: Mapping[str, object]) -> None:
        """Write the scores of the session, for lists."""
        self.stream.log("/nisus/summary", rr.AnyValues(json=json.dumps(dict(found))), static=True)

    def annotations(self, notes: tuple[Annotation, ...]) -> None:
        """Write the notes that were added, changed or deleted since the last call."""
        if notes is self._annotations:
            return
        before, numbers = {note.number: note for note in self._annotations}, {note.number for note in notes}
        rows = [note for note in notes if note != before.get(note.number)]
        rows += [replace(note, text="") for number, note in before.items() if number not in numbers]
        if rows:
            self._send(
                "annotations",
                "change",
                np.arange(self._changes, self._changes + len(rows)),
                number=np.array([note.number for note in rows], np.int64),
                t=np.array([note.t for note in rows], np.int64),
                text=[note.text for note in rows],
            )
        self._annotations, self._changes = notes, self._changes + len(rows)

    def write(self, pull: Pull) -> None:
        """Write events and notices."""
        if pull.notices:
            self._send(
                "notices",
                "notice",
                [line.number for line in pull.notices],
                t=np.array([line.t for line in pull.notices], np.int64),
                level=[line.level for line in pull.notices],
                text=[line.text for line in pull.notices],
            )
        count = len(pull.events)
        if not count:
            return
        # As Arrow arrays: Rerun would turn NumPy arrays into Python lists, which is fifty times slower.
        flat: dict[str, pa.Array] = {}
        for name, column in zip(pull.events._fields, pull.events, strict=True):
            if column.ndim == 1:
                flat[name] = pa.array(column)
            else:
                flat |= {f"{name}_{k}": pa.array(column[:, k]) for k in range(column.shape[1])}
        self._send("events", TIMELINE, np.arange(pull.first, pull.first + count), **flat)
        self.rows += count

    def flush(self) -> None:
        """Hand the messages logged since to the operating system.

        Raises:
            OSError: If the file cannot grow; it then ends where it ended before.
        """
        data = self._bytes.read(flush_timeout_sec=FLUSH_TIMEOUT_S)
        if data:
            # Each piece is a stream of its own: the file keeps the header of the first, and no footer.
            end = next((at for at, kind, _ in messages(io.BytesIO(data), len(data)) if kind == END_MESSAGE), len(data))
            self._append(data[STREAM_HEADER if self.size else 0 : end])

    def close(self) -> None:
        """Write the rest and the end message, and close the file also if that fails.

        Raises:
            OSError: As `flush`.
        """
        try:
            self.flush()
            self._append(MESSAGE_HEADER.pack(END_MESSAGE, 0))
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self.stream.disconnect()

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._file, self.size)
                os.lseek(self._file, self.size, os.SEEK_SET)
            raise
        self.size += len(data)


def summary_of(engine: Running) -> JsonObject:
    """Return the scores of the running fold: see `summary`; fewer if they cannot be computed."""
    try:
        pull = copy_rows(engine)
        tuning, estimator = engine.folded_with()
        if pull is None:
            return {"estimator": estimator}
        return summary(estimator, tuning, pull.events, pull.track, pull.pictures)
    except NisusError:
        return {}


def summary(
    estimator: str, tuning: Tuning, events: Events, track: Track, pictures: Sequence[Picture] = ()
) -> JsonObject:
    """Return the scores of a track: estimator, mean NIS with bounds and verdict, and one error.

    `error` is {name, rmse, unit, coverage, against} of the first state with a truth, or else of a held-out sensor.
    """
    found = score(track, events, tuning.model, pictures, gate=tuning.gate, baseline=tuning.baseline)
    nis = {name: getattr(found, name) for name in ("nis", "nis_low", "nis_high")}
    nis |= {"nis_dof": found.nis_verdict.dof, "nis_words": found.nis_verdict.words}
    return dict(plain({"estimator": estimator} | nis | {"error": _error(found, tuning.model)}))


def _error(found: Score, model: StateSpaceModel) -> JsonObject | None:
    units = units_by_name(model)
    for against, part in (("truth", found.states), ("held out", found.held_out)):
        for name, fit in part.items():
            if math.isfinite(fit.rmse):
                values = {"name": name, "rmse": fit.rmse, "unit": units.get(name, "")}
                return {**values, "coverage": fit.coverage, "against": against}
    return None
