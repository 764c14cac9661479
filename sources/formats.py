"""File formats of recordings, by the ending of the name."""

from __future__ import annotations

import filecmp
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

from estimators.errors import SourceError

from .archives import COMPRESSIONS, ZIP, archive_of, is_file, members

CAN_LOGS = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")  # Endings of CAN logs

EITHER = (".csv", ".txt")  # Endings of CAN logs and of tables, which their content tells apart

TABLES = (".csv", ".parquet", ".pq", ".feather", ".arrow", ".mat", ".npz")

MDF = (".mf4", ".mdf", ".dat")  # Endings of ASAM MDF, which holds signals or frames of CAN

EXTRAS = {
    ".mcap": "robotics", ".db3": "robotics", ".xlsx": "excel", ".xls": "excel", ".ods": "excel", ".tdms": "tdms",
    ".mf4": "mf4", ".mdf": "mf4", ".dat": "mf4",
}  # fmt: skip
"""Endings of tables that a bundled extension reads, which is named where it is missing."""


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


def is_recording(name: str) -> bool:
    """Return whether a file of this name can replace a twin's own recording."""
    return suffix_of(Path(name)) in {*CAN_LOGS, *tables(), ZIP}


def files_of(path: Path) -> list[Path]:
    """Return the recordings in a folder or a ZIP archive, in their order; any other path as it is.

    A folder that is one recording names its files; of any other one they are all recordings of the one format in it, by
    name.

    Raises:
        SourceError: If there are none, or of several formats, or they cannot be read.
    """
    for name, files in added("folders").items() if path.is_dir() else ():
        if (path / name).is_file():
            return list(files()(path))
    if path.is_dir():
        inside = sorted(one for one in path.iterdir() if one.is_file())
    elif path.suffix.lower() == ZIP and path.is_file():
        inside = members(path)
    else:
        return [path]
    found = [one for one in inside if is_recording(one.name) and one.name[0] not in "._"]
    kinds = sorted({suffix_of(one) for one in found})
    if not found:
        endings = ", ".join(dict.fromkeys((*TABLES, *CAN_LOGS)))
        raise SourceError(f"{path}: holds no recording; name a file that ends in {endings}")
    if len(kinds) > 1:
        choice = f"{path}/*{kinds[0]}" if path.is_dir() else f"{found[0]}"
        raise SourceError(f"{path}: holds recordings of several formats ({', '.join(kinds)}); name some: {choice}")
    return [file for one in found for file in (files_of(one) if kinds == [ZIP] else [one])]


def is_whole(folder: Path) -> bool:
    """Return whether a folder is one recording, whose files `files_of` returns."""
    return folder.is_dir() and any((folder / name).is_file() for name in added("folders"))


def check_once(files: Sequence[Path], where: str = "") -> None:
    """Refuse a recording that is named twice or copied, as it would count twice; `where` begins the message.

    Raises:
        SourceError: Naming it.
    """
    seen: set[Path] = set()
    alike: dict[tuple[int, bytes], Path] = {}
    for path in files:
        if path.resolve() in seen:
            raise SourceError(f"{where}{path}: is given twice; name each recording once")
        seen.add(path.resolve())
        with suppress(OSError), path.open("rb") as file:  # Otherwise it is reported when it is read.
            other = alike.setdefault((path.stat().st_size, file.read(4096)), path)
            if other is not path and filecmp.cmp(other, path, shallow=False):
                raise SourceError(f"{where}{path}: has the same content as {other}; leave one out")


def check_present(path: Path) -> None:
    """Refuse a recording that is missing or empty.

    Raises:
        SourceError: Naming it.
    """
    if not is_file(path):
        raise SourceError(f"{path}: there is no such file; check the path of the recording")
    if archive_of(path) is None and path.stat().st_size == 0:
        raise SourceError(f"{path}: the file is empty; record it again")


BEGINNINGS = {
    b"PK\x03\x04": "an Excel workbook or a ZIP archive; let its name end in .xlsx or .zip",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook; let its name end in .xls",
    b"TDSm": "TDMS; let its name end in .tdms",
    b"ARROW1": "Arrow; let its name end in .arrow",
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


def holds_signals(path: Path) -> bool:
    """Return whether a file is MDF and holds no frames of CAN, by its blocks of text, which are never compressed."""
    if not path.is_file():
        return False  # It is reported when the file is read.
    with path.open("rb") as file:
        if file.read(4) not in (b"MDF ", b"UnFi"):
            return False
        overlap = b""
        while part := file.read(2**24):
            if b"CAN_DataFrame" in overlap + part:
                return False
            overlap = part[-16:]
    return True
