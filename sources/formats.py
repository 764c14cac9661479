"""File formats of recordings, by the ending of the name, and compressed files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from estimators.errors import SourceError

CAN_LOGS = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")  # Endings of CAN logs

BAGS = (".mcap", ".db3")  # Endings of the files of bags of ROS 2

TABLES = (".csv", ".parquet", ".pq", ".mat", ".npz", *BAGS)
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


BAG_FILE = "metadata.yaml"  # File of a folder that is a bag of ROS 2, with the names of its recordings


def files_of(path: Path) -> list[Path]:
    """Return the recordings of a folder that is a bag, in their order; any other path as it is.

    Raises:
        SourceError: If the bag does not name its recordings, or they are compressed as files.
    """
    content = path / BAG_FILE
    if not content.is_file():
        return [path]
    import yaml

    try:
        info = yaml.safe_load(content.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        files = [path / Path(name).name for name in info["relative_file_paths"]]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        raise SourceError(f"{content}: does not list the files of the bag; name its .mcap or .db3 files") from None
    for file in files:
        if file.suffix not in BAGS:
            raise SourceError(f"{file}: is no {' or '.join(BAGS)}; if it is compressed, unpack it and name the file")
    return files


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
    b"MDF ": "MF4; let its name end in .mf4",
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
