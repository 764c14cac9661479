"""The track of a run as CSV or Parquet, piece by piece: the columns that `nisus fold` writes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from estimators.diagnostics.episodes import Episode, JudgedRows, episodes_of
from estimators.errors import ConfigError
from estimators.events.maintenance import model_versions
from estimators.interface.table import table_of
from estimators.registry import find_entry

from ...live.history_copy import copy_rows
from ...live.outputs import Pull
from ...live.revisions import Revision
from ...live.running_fold import Running

PIECE = 8192
"""Rows that are formatted at once."""

KINDS = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet"}
"""What can be written, and its media type."""


def tables(rows: RunRows, part: slice) -> Iterator[Any]:
    """The rows of a part as tables of at most `PIECE` rows, at least one: they are of one schema."""
    run, pull = rows
    model, found = run.tuning.model, rows.episodes()
    versions = model_versions(pull.events, pull.version)
    for start in range(part.start, max(part.stop, part.start + 1), PIECE):
        piece = slice(start, min(part.stop, start + PIECE))
        events = pull.events.select(piece)
        # A maintenance begins a version at its own row, also where that is the first of a piece.
        begun = int(model_versions(events.select(slice(0, 1)), 0)[0]) if len(events) else 0
        before = int(versions[start]) - begun if len(events) else pull.version
        yield table_of(
            model, events, pull.track.select(piece), found,
            tuning_version=run.tuning.version, tuning=run.tuning.name,
            model_version=before,
        )  # fmt: skip


def encoded(kind: str, parts: Iterable[Any]) -> Iterator[bytes]:
    """Tables of one schema as the bytes of one file, as they come."""
    sink = _Sink()
    writer = None
    for table in parts:
        if writer is None:
            writer = _writer(kind, sink, table.schema)
        writer.write_table(table)
        yield sink.take()
    if writer is not None:
        writer.close()
        yield sink.take()


def _writer(kind: str, sink: _Sink, schema: Any) -> Any:
    if kind == "csv":
        import pyarrow.csv

        return pyarrow.csv.CSVWriter(sink, schema)
    import pyarrow.parquet

    return pyarrow.parquet.ParquetWriter(sink, schema)


class _Sink:
    """A file that is handed on as it is written."""

    closed = False

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._at = 0

    def write(self, data: Any) -> int:
        piece = bytes(data)
        self._pieces.append(piece)
        self._at += len(piece)
        return len(piece)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        pass

    def close(self) -> None:
        pass

    def take(self) -> bytes:
        """Return the bytes written since the last call."""
        pieces, self._pieces = self._pieces, []
        return b"".join(pieces)


MAX_COPIES = 20
"""Times that the rows are copied while a late reading, or another revision, comes in between."""


class RunRows(NamedTuple):
    """A run, and the rows that it had folded."""

    run: Revision
    pull: Pull

    @property
    def marginal(self) -> bool:
        """Whether the filter's predictions are not Gaussian."""
        return find_entry(self.run.estimator).family in ("particle", "ensemble")

    def episodes(self) -> list[Episode]:
        """Return its episodes by their start, as `nisus fold` finds them."""
        events, track, tuning = self.pull.events, self.pull.track, self.run.tuning
        if not len(events):
            return []
        return episodes_of(JudgedRows(tuning.model, tuning, self.marginal, events, track))

    def between(self, since: int | None, until: int | None) -> slice:
        """The rows from one time to another, ns; None is the end that there is."""
        t = self.pull.events.t
        start = 0 if since is None else int(np.searchsorted(t, since))
        stop = t.size if until is None else int(np.searchsorted(t, until, side="right"))
        return slice(start, max(start, stop))


def rows_of_run(engine: Running, number: int | None = None) -> RunRows:
    """A run and its rows: of what runs a copy, of another what was kept.

    Args:
        engine: Whose.
        number: Of the run; None is the one that runs.

    Raises:
        ConfigError: If there is no such run, nothing has come yet, or its track is gone.
    """
    for _ in range(MAX_COPIES):
        running = engine.revisions.runs[-1]
        run = running if number is None else engine.revisions.find(number)
        if run is not running:
            if run.track is None:
                raise ConfigError(f"run {run.number}: its track is gone; load it, and it is folded again")
            return RunRows(run, run.track)
        if not engine.span()[1]:
            raise ConfigError(f"run {run.number}: no reading has come yet")
        pull = copy_rows(engine)
        if pull is not None and pull.revision == run.number:
            return RunRows(run, pull)
    raise ConfigError("its rows change while they are copied; ask again")
