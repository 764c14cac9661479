"""Track of a run as CSV or Parquet, in pieces, with the columns of `nisus fold`."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from estimators.diagnostics.episodes import Episode, JudgedRows, episodes_of
from estimators.errors import ConfigError
from estimators.events.maintenance import model_versions
from estimators.interface.table import table_of
from estimators.registry import find_entry

from ..engine.copies import Pull
from ..engine.history_copy import copy_rows
from ..engine.revisions import Revision
from ..engine.running_fold import Running

if TYPE_CHECKING:
    from pyarrow import Table

PIECE = 8192
"""Rows formatted at once."""

KINDS = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet"}
"""Formats and their media types."""


def tables(rows: RunRows, part: slice) -> Iterator[Table]:
    """Yield the rows of a part as tables of at most `PIECE` rows and one schema, at least one table."""
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


def encoded(kind: str, parts: Iterable[Table]) -> Iterator[bytes]:
    """Yield tables of one schema as the bytes of one file."""
    import pyarrow.csv
    import pyarrow.parquet

    sink, writer = _Sink(), None
    for table in parts:
        if writer is None:
            make = pyarrow.csv.CSVWriter if kind == "csv" else pyarrow.parquet.ParquetWriter
            writer = make(sink, table.schema)
        writer.write_table(table)
        yield sink.drain()
    if writer is not None:
        writer.close()
        yield sink.drain()


class _Sink(io.BytesIO):
    """Buffer whose bytes are taken while a file is written."""

    _taken = 0

    def tell(self) -> int:
        return self._taken + super().tell()

    def close(self) -> None:
        """Stay open: the last bytes are taken after the end of the file."""

    def drain(self) -> bytes:
        """Return the bytes written since the last call."""
        data = self.getvalue()
        self._taken += len(data)
        self.seek(0)
        self.truncate()
        return data


MAX_COPIES = 20
"""Attempts to copy the rows while late measurements or another revision interrupt."""


class RunRows(NamedTuple):
    """A run and its rows."""

    run: Revision
    pull: Pull

    @property
    def marginal(self) -> bool:
        """Whether the filter's predictions are not Gaussian."""
        return find_entry(self.run.estimator).marginal

    def episodes(self) -> list[Episode]:
        """Return its episodes by their start, as `nisus fold` finds them."""
        events, track, tuning = self.pull.events, self.pull.track, self.run.tuning
        if not len(events):
            return []
        return episodes_of(JudgedRows(tuning.model, tuning, self.marginal, events, track))

    def between(self, since: int | None, until: int | None) -> slice:
        """Return the slice of rows from one time to another, ns; None is the start or the end."""
        t = self.pull.events.t
        start = 0 if since is None else int(np.searchsorted(t, since))
        stop = t.size if until is None else int(np.searchsorted(t, until, side="right"))
        return slice(start, max(start, stop))


def rows_of_run(engine: Running, number: int | None = None) -> RunRows:
    """Return a run and its rows: a copy for the running one (None), the kept rows for another.

    Raises:
        ConfigError: If there is no such run, no measurement has arrived, or its track is gone.
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
