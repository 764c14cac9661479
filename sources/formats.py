"""File formats of recordings, by the ending of the name, and compressed files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, Literal

from estimators.errors import SourceError

CAN_LOGS = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")  # Endings of CAN logs

EITHER = (".csv", ".txt")  # Endings of CAN logs and of tables, which their content tells apart

TABLES = (".csv", ".parquet", ".pq", ".mat", ".npz", ".mf4", ".mdf", ".dat")

MDF = (".mf4", ".mdf", ".dat")  # Endings of ASAM MDF, which holds signals or frames of CAN

EXTRAS = {".mcap": "robotics", ".db3": "robotics"}
"""Endings of tables that a bundled extension reads, which is named where it is missing."""

COMPRESSIONS = (".gz", ".bz2", ".lz4", ".zst")
"""Endings of compressed files, after that of the format. Of CAN logs, python-can reads `.gz` only."""


def added(kind: Literal["tables", "folders"]) -> Mapping[str, Callable]:
    """Return what extensions add, each as a function that loads it; the application sets it, a reader process has none.

    added("tables"): a `tables.rows.TableFormat`, by the ending of the name. added("folders"): for folders that are one
    recording, by a file in them, a function that returns the recordings in a folder.
    """
    return {}


def tables() -> tuple[str, ...]:
    """Return the endings of tables. A table of any other ending is read as CSV."""
    return *TABLES, *dict.fromkeys((*EXTRAS, *added("tables")))


def suffix_of(path: Path) -> str:
    """Return the ending that names the format, in lower case: `.csv` of `Drive.CSV.gz`."""
    stem, suffix = os.path.splitext(path.name.lower())
    return os.path.splitext(stem)[1] if suffix in COMPRESSIONS else suffix


def is_compressed(path: Path) -> bool:
    """Return whether the file as a whole is compressed, by its ending."""
    return path.suffix.lower() in COMPRESSIONS


def is_recording(name: str) -> bool:
    """Return whether a file of this name can replace a twin's own recording."""
    return suffix_of(Path(name)) in {*CAN_LOGS, *tables()}


def files_of(path: Path) -> list[Path]:
    """Return the recordings of a folder that is one recording, in their order; any other path as it is.

    Raises:
        SourceError: If the folder does not name its recordings, or they cannot be read.
    """
    for name, files in added("folders").items() if path.is_dir() else ():
        if (path / name).is_file():
            return list(files()(path))
    return [path]


def is_whole(folder: Path) -> bool:
    """Return whether a folder is one recording, whose files `files_of` returns."""
    return folder.is_dir() and any((folder / name).is_file() for name in added("folders"))


def check_once(files: Sequence[Path], where: str = "") -> None:
    """Refuse a recording that is named twice, as its measurements would count twice; `where` begins the message.

    Raises:
        SourceError: Naming it.
    """
    seen: set[Path] = set()
    for path in files:
        if path.resolve() in seen:
            raise SourceError(f"{where}{path}: is given twice; name each recording once")
        seen.add(path.resolve())


def check_present(path: Path) -> None:
    """Refuse a recording that is missing or empty.

    Raises:
        SourceError: Naming it.
    """
    if not path.is_file():
        raise SourceError(f"{path}: there is no such file; check the path of the recording")
    if path.stat().st_size == 0:
        raise SourceError(f"{path}: the file is empty; record it again")


BEGINNINGS = {
    b"PK\x03\x04": "an Excel workbook or a ZIP archive; export the sheet as CSV",
    b"\x89HDF": "HDF5; export it as Parquet or CSV",
    b"%PDF": "a PDF; give a CSV",
    b"RRF": "a recording of Nisus; nisus review opens it",
    b"MDF ": "an MDF file; let its name end in .mf4",
    b'VERSION "': "a DBC; name it with --dbc",
    b"\x89MCAP0": "an MCAP file; let its name end in .mcap",
    b"#ROSBAG V": "a bag of ROS 1; rosbags-convert makes one of ROS 2",
    b"{": "JSON; export it as CSV",
    b"[{": "JSON; export it as CSV",
    b"<": "XML or HTML; export it as CSV",
}
"""Files that are no table, by their first bytes, and the remedy."""


def refuse_others(path: Path, head: bytes) -> None:
    """Refuse a file that begins as one of another format.

    Raises:
        SourceError: Naming that format.
    """
    begin = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    for start, what in BEGINNINGS.items():
        if begin.startswith(start):
            raise SourceError(f"{path}: is no table; it is {what}")
    if path.suffix.lower() in (".yaml", ".yml"):
        raise SourceError(f"{path}: is no table; it is YAML, as of a twin, whose recording nisus fold reads")


def open_binary(path: Path) -> BinaryIO:
    """Open a file for reading; a compressed one is decompressed while it is read, and cannot be seeked."""
    if not is_compressed(path):
        return path.open("rb")
    import pyarrow  # Here, not above: it takes long, and most files are not compressed.

    stream: BinaryIO = pyarrow.input_stream(path, compression="detect")
    return stream
