"""Signals of an MDF recording (.mf4, .mdf, .dat), as ETAS INCA, Vector CANape and MATLAB write them.

Each channel group is a raster with its own times. Its samples are the rows, of which those of other groups are blank; a
column is the channel with its unit, `nEng [1/min]`, after the name of its group if several groups have such a channel.
A sample whose invalidation bit is set is a missing value. Texts and groups without a time are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from estimators.errors import SourceError
from sources.can import check_mf4
from sources.can.mf4 import lost_records, opened, start_of
from sources.source import TRUNCATED
from sources.tables.rows import TableFormat
from sources.tables.text import CHUNK_ROWS, UNREADABLE, Chunk, Column, Problem
from sources.worker_process import gist

if TYPE_CHECKING:
    from asammdf import MDF

TIME = "time"  # Column of the times

TIME_SYNC = 1  # Type of a master channel that counts seconds; others count degrees, metres or samples


class _Place(NamedTuple):
    """Where the samples of a column are."""

    group: int
    channel: int


@contextmanager
def _file(path: Path) -> Iterator[tuple[MDF, bytes, dict[str, _Place]]]:
    """Open a file: it, its bytes, and the place of each column."""
    check_mf4(path)
    with opened(path) as (mdf, content):
        yield mdf, content, _columns(mdf)


def _columns(mdf: MDF) -> dict[str, _Place]:
    numeric = range(6) if mdf.version >= "4" else (*range(7), *range(9, 17))
    found: list[tuple[str, str, _Place]] = []
    for k, group in enumerate(mdf.groups):
        master = mdf.masters_db.get(k)
        if not group.channel_group.cycles_nr or master is None:
            continue
        if getattr(group.channels[master], "sync_type", TIME_SYNC) != TIME_SYNC:
            continue
        label = getattr(group.channel_group, "acq_name", "") or f"group {k}"
        for j, channel in enumerate(group.channels):
            if j != master and channel.data_type in numeric and not group.channel_dependencies[j]:
                unit = str(mdf.get_channel_unit(group=k, index=j) or "").strip()
                found.append((f"{channel.name} [{unit}]" if unit else channel.name, label, _Place(k, j)))
    counts = Counter(name for name, _, _ in found)
    named = [(name if counts[name] == 1 else f"{label}.{name}", place) for name, label, place in found]
    counts = Counter(name for name, _ in named)
    return {name if counts[name] == 1 else f"{place.group}.{name}": place for name, place in named}


def mdf_names(path: Path, time: str = "") -> list[str]:
    """Return the columns of an MDF file.

    Raises:
        SourceError: If it cannot be read, or holds no signals.
    """
    with _file(path) as (_, _, places):
        if not places:
            raise SourceError(f"{path}: it holds no signals with a time; export them again, or as CSV")
        return [TIME, *places]


def read_mdf(path: Path, time: str, columns: Sequence[Column], problem: Problem) -> Generator[Chunk, None, None]:
    """Yield the samples of the groups of these columns, in order of time.

    Raises:
        SourceError: If the file cannot be read.
    """
    import pyarrow

    if time != TIME:
        raise SourceError(f"{path}: the times of an MDF file are in its column {TIME!r}, not {time!r}; name that one")
    with _file(path) as (mdf, content, places):
        start = start_of(mdf)
        parts: list[tuple[np.ndarray, list[int], np.ndarray]] = []
        for group in sorted({places[str(column)].group for column in columns if str(column) in places}):
            mine = [(k, places[str(c)]) for k, c in enumerate(columns) if places[str(c)].group == group]
            seconds = np.asarray(mdf.get_master(group), np.float64)
            if lacking := int(mdf.groups[group].channel_group.cycles_nr) - seconds.size:
                problem(TRUNCATED, seconds.size, f"{lacking} samples of group {group} are missing")
            values = np.full((seconds.size, len(mine)), np.nan)
            for j, (k, place) in enumerate(mine):
                try:
                    values[:, j] = _values(mdf, place)
                except Exception as error:  # noqa: BLE001  of a damaged file asammdf raises anything
                    problem(UNREADABLE, 1, f"{columns[k]} cannot be read ({gist(error)}); its values are missing")
            parts.append((start + np.round(seconds * 1e9).astype(np.int64), [k for k, _ in mine], values))
        if lost := lost_records(mdf, content):
            problem(TRUNCATED, sum(t.size for t, _, _ in parts), lost)
    t = np.concatenate([part[0] for part in parts]) if parts else np.zeros(0, np.int64)
    of = np.repeat(np.arange(len(parts)), [part[0].size for part in parts])
    row = np.concatenate([np.arange(part[0].size) for part in parts]) if parts else t
    order = np.argsort(t, kind="stable")
    for first in range(0, t.size, CHUNK_ROWS):
        rows = order[first : first + CHUNK_ROWS]
        cells, blank = np.full((rows.size, len(columns)), np.nan), np.ones((rows.size, len(columns)), np.bool_)
        for k, (_, filled, values) in enumerate(parts):
            here = np.flatnonzero(of[rows] == k)
            cells[here[:, None], filled] = values[row[rows[here]]]
            blank[here[:, None], filled] = False
        stamps = pyarrow.array(t[rows], pyarrow.timestamp("ns", "UTC"))
        yield Chunk(np.arange(first, first + rows.size) + 1, stamps, cells, blank)


def _values(mdf: MDF, place: _Place) -> np.ndarray:
    """Return the samples of a column, converted; NaN of one that is marked invalid.

    An enumeration is its numbers.
    """
    signal = mdf.get(group=place.group, index=place.channel, ignore_invalidation_bits=True)
    if signal.samples.dtype.kind not in "biuf":
        signal = mdf.get(group=place.group, index=place.channel, ignore_invalidation_bits=True, raw=True)
    values = np.array(signal.samples, np.float64)
    if signal.invalidation_bits is not None:
        values[np.asarray(signal.invalidation_bits, np.bool_)] = np.nan
    return values


SIGNALS = TableFormat(mdf_names, read_mdf, sparse=True)
