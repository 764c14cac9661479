"""Compressed files, and files in ZIP archives, which have a path as if the archive were a folder."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO, cast

from estimators.errors import SourceError

ZIP = ".zip"

COMPRESSIONS = (".gz", ".bz2", ".lz4", ".zst")
"""Endings of compressed files, after that of the format. Of CAN logs, python-can reads `.gz` only."""


def is_compressed(path: Path) -> bool:
    """Return whether the file as a whole is compressed, by its ending, or as a part of a ZIP archive."""
    return path.suffix.lower() in COMPRESSIONS or archive_of(path) is not None


def archive_of(path: Path) -> Path | None:
    """Return the ZIP archive in which a file is, as `export.zip/drive.csv`; None of any other file."""
    zips = (folder for folder in path.parents if folder.suffix.lower() == ZIP)
    return next((folder for folder in zips if folder.is_file()), None)


def is_file(path: Path) -> bool:
    """Return whether there is such a file, in a folder or a ZIP archive."""
    archive = archive_of(path)
    return path.is_file() if archive is None else path in members(archive)


def members(archive: Path) -> list[Path]:
    """Return the files in a ZIP archive.

    Raises:
        SourceError: If it cannot be read.
    """
    try:
        with zipfile.ZipFile(archive) as file:
            return sorted(archive / name for name in file.namelist() if not name.endswith("/"))
    except (OSError, zipfile.BadZipFile) as error:
        raise SourceError(f"{archive}: it cannot be read as ZIP ({error}); check that it is complete") from None


UNREADABLE_ERRORS = (OSError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError)
"""Errors of `open_binary` and of reading such a file: it is damaged, or in an archive with a password."""


def open_binary(path: Path) -> BinaryIO:
    """Open a file for reading; a compressed one is decompressed while it is read, and cannot be seeked."""
    if (archive := archive_of(path)) is not None:
        with zipfile.ZipFile(archive) as file:
            return cast(BinaryIO, file.open(path.relative_to(archive).as_posix()))
    if not is_compressed(path):
        return path.open("rb")
    import pyarrow  # Here, not above: it takes long, and most files are not compressed.

    stream: BinaryIO = pyarrow.input_stream(path, compression="detect")
    return stream
