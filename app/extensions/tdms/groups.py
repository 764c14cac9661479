"""Groups of a TDMS file: the channels of one length are the columns of a table.

Waveforms (`wf_increment`, `wf_start_offset`, `wf_start_time`) have the column `time`: dates, or seconds if they have no
start. Channels of other lengths or other times are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimators.errors import SourceError, nearest
from sources.tables.binary import chunks_of, content_of, readable
from sources.tables.dialect import Dialect
from sources.tables.rows import TableFormat
from sources.tables.text import CHUNK_ROWS, READ_AS, Chunk, Column, Problem
from sources.units import heading_unit

TIME = "time"  # Column of the times of waveforms


def channel_names(path: Path, time: str, dialect: Dialect) -> list[str]:
    """Return the columns of a group; raises SourceError as `_columns`."""
    return list(_columns(path, time, dialect)[0])


def read_channels(
    path: Path, time: str, columns: Sequence[Column], problem: Problem, dialect: Dialect
) -> Iterator[Chunk]:
    """Yield the samples of channels; the first problem is the remark about their group, if any."""
    found, remark = _columns(path, time, dialect)
    if remark:
        problem(READ_AS, 1, remark)
    for column in columns:
        if not isinstance(column, str):
            raise SourceError(f"{path}: {column.column} holds numbers, not text; give a number")
    arrays = {str(name): (found[str(name)], [k], [0]) for k, name in enumerate(columns)}
    yield from chunks_of(found[time], arrays, CHUNK_ROWS)


GROUPS = TableFormat(channel_names, read_channels, dialect=True)


def _columns(path: Path, time: str, dialect: Dialect) -> tuple[dict[str, np.ndarray], str]:
    """Return the columns of the group with samples, or of the named one, and a remark.

    Raises:
        SourceError: If the file cannot be read, there is no such group, or none with numbers.
    """
    with readable(path, "TDMS"):
        from nptdms import TdmsFile

        file = TdmsFile.read(content_of(path))
    channels: dict[str, list[Any]] = {
        group.name: [one for one in group.channels() if len(one) and one.dtype.kind in "biufM"]
        for group in file.groups()
    }
    names = [name for name, own in channels.items() if own]
    if not names:
        raise SourceError(f"{path}: no group has channels with numbers; record it again")
    if dialect.sheet is not None and dialect.sheet not in names:
        raise SourceError(f"{path}: there is no group {dialect.sheet!r} of numbers; {nearest(dialect.sheet, names)}")
    group = dialect.sheet or names[0]
    remarks = [f"group {group!r} is read, of {', '.join(names)} (sheet, --sheet)"] * (group != dialect.sheet)
    own = channels[group]
    by_name = {_name(one): one for one in own}
    wanted = _clock(by_name[time]) if time in by_name else Counter(map(_clock, own)).most_common(1)[0][0]
    kept = {name: one for name, one in by_name.items() if _clock(one) == wanted}
    if left := [name for name in by_name if name not in kept]:
        remarks.append(f"channels of another length or time are left out: {', '.join(left)}")
    found = {name: one[:] for name, one in kept.items()}
    count, start, offset, step = wanted
    if step and TIME not in found:
        seconds = np.arange(count) * step + offset
        found = {TIME: seconds if start is None else start + np.round(seconds * 1e9).astype("timedelta64[ns]"), **found}
    return found, ", ".join(remarks if len(names) > 1 else remarks[1:])


def _name(channel: Any) -> str:
    """Return the name of a channel, with its unit."""
    unit = channel.properties.get("unit_string", "")
    name = f"{channel.name} [{unit}]"
    return name if unit and heading_unit(name) and not heading_unit(channel.name) else channel.name


def _clock(channel: Any) -> tuple[int, np.datetime64 | None, float, float]:
    """Return the number of samples, and start, offset and increment (s) of a waveform; no start before 1970 is one."""
    of = channel.properties.get
    start = of("wf_start_time")
    known = start is not None and np.datetime64(start, "ns") >= np.datetime64(0, "ns")
    step = float(of("wf_increment", 0.0))
    return len(channel), np.datetime64(start, "ns") if known and step else None, float(of("wf_start_offset", 0.0)), step
