"""The track of a run as CSV or Parquet, piece by piece: the columns that `nisus fold` writes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from estimators.events.maintenance import model_versions
from estimators.interface.table import table_of

from .run_rows import RunRows

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
        """What was written since."""
        pieces, self._pieces = self._pieces, []
        return b"".join(pieces)
