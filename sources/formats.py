"""File formats of recordings, by the ending of the name, and compressed files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

CAN_LOGS = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")  # Endings of CAN logs

TABLES = (".csv", ".parquet", ".pq", ".mat", ".npz")
"""Endings of tables. A table of any other ending is read as CSV."""

COMPRESSIONS = (".gz", ".bz2", ".lz4", ".zst")
"""Endings of compressed files, after that of the format. Of CAN logs, python-can reads `.gz` only."""


def suffix_of(path: Path) -> str:
    """Return the ending that names the format, in lower case: `.csv` of `Drive.CSV.gz`."""
    stem, suffix = os.path.splitext(path.name.lower())
    return os.path.splitext(stem)[1] if suffix in COMPRESSIONS else suffix


def is_compressed(path: Path) -> bool:
    """Return whether the file as a whole is compressed, by its ending."""
    return path.suffix.lower() in COMPRESSIONS


def is_recording(name: str) -> bool:
    """Return whether a file of this name can replace a twin's own recording."""
    return suffix_of(Path(name)) in {*CAN_LOGS, *TABLES}


def open_binary(path: Path) -> BinaryIO:
    """Open a file for reading; a compressed one is decompressed while it is read, and cannot be seeked."""
    if not is_compressed(path):
        return path.open("rb")
    import pyarrow  # Here, not above: it takes long, and most files are not compressed.

    stream: BinaryIO = pyarrow.input_stream(path, compression="detect")
    return stream
