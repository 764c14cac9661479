"""The folder of recordings and dropped logs: list, receive, delete.

Of other folders only the files are listed that this session itself has recorded, wherever the command line said.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from estimators.errors import ConfigError, NisusError, quoted
from sources.formats import CAN_LOGS, EITHER, is_recording, suffix_of, tables

from ...record.rrd_file import Disk
from ...result import JsonObject

if TYPE_CHECKING:
    from ...record.reader import Facts

RECORDING = ".rrd"

DATABASE = ".dbc"
"""Suffix of a file that describes the frames of CAN logs."""

PART = ".part"
"""Suffix of a file that is still arriving; its name begins with a dot, so that lists do not show it."""

MAX_SUMMARISED_BYTES = 256 * 2**20
"""Largest recording that is read for the list."""

MAX_NAME_BYTES = 200
"""Longest file name, so that a number and the suffix of a part still fit."""

NO_FACTS: JsonObject = {"twin": None, "estimator": None, "seconds": None, "summary": {}}


class Recordings:
    """One folder. Names come from a browser, so each is checked before a file is touched.

    `recorded` returns the files that the session has recorded; those outside the folder are listed, too.
    """

    def __init__(self, folder: Path, recorded: Callable[[], Sequence[Path]] = lambda: ()) -> None:
        self.folder, self._recorded = folder, recorded
        self._known: dict[tuple[str, int, int], Facts | str] = {}
        self._lock = threading.Lock()
        self._looking = False

    def entries(self, busy: Callable[[Path], bool] = lambda path: False) -> list[JsonObject]:
        """Return the files, newest first: facts of a recording, or an `error`; `folder` is set outside this one.

        Facts are read in a thread, for the next call; `looking` is true while they are missing.

        Args:
            busy: Whether a file is being written.
        """
        found: list[JsonObject] = []
        unknown: list[tuple[Path, tuple[str, int, int]]] = []
        inside = sorted(self.folder.iterdir()) if self.folder.is_dir() else []
        for path in [*inside, *self._elsewhere().values()]:
            log = path.suffix.lower() != RECORDING
            if path.is_symlink() or not path.is_file() or path.name.startswith("."):
                continue
            database = path.suffix.lower() == DATABASE
            if log and not database and not is_log(path.name):
                continue
            stat = path.stat()
            key = (str(path), stat.st_mtime_ns, stat.st_size)
            known = self._known.get(key)
            if busy(path):
                known = "is being recorded"
            elif not log and known is None and stat.st_size > MAX_SUMMARISED_BYTES:
                known = "is large: open it to see its content"
            elif not log and known is None:
                unknown.append((path, key))
            found.append(
                {
                    "name": path.name,
                    "bytes": stat.st_size,
                    "modified": stat.st_mtime,
                    "log": log and not database,
                    "database": database,
                    "error": known if isinstance(known, str) else None,
                    "looking": known is None and not log,
                    "folder": None if path in inside else str(path.parent),
                }
                | (NO_FACTS if known is None or isinstance(known, str) else asdict(known))
            )
        self._look(unknown)
        return sorted(found, key=lambda entry: -entry["modified"])

    def _look(self, unknown: list[tuple[Path, tuple[str, int, int]]]) -> None:
        with self._lock:
            if self._looking or not unknown:
                return
            self._looking = True

        def read() -> None:
            from ...record.reader import facts_of

            try:
                for path, key in unknown:
                    try:
                        self._known[key] = facts_of(path)
                    except (NisusError, OSError) as error:
                        self._known[key] = str(error).removeprefix(f"{path.name}: ")
            finally:
                self._looking = False

        threading.Thread(target=read, name="recordings", daemon=True).start()

    def _elsewhere(self) -> dict[str, Path]:
        """Return by name the recordings of this session outside the folder; files in the folder take precedence."""
        home = self.folder.absolute()
        found = {path.name: path.absolute() for path in self._recorded() if path.absolute().parent != home}
        return {name: path for name, path in found.items() if not (self.folder / name).exists()}

    def find(self, name: str) -> Path:
        """Return the file of that name.

        Raises:
            ConfigError: If no file of this folder, or of this session, has that name.
        """
        path = self._elsewhere().get(name) if isinstance(name, str) else None
        path = path or self.folder / _checked(name)
        if path.is_symlink() or not path.is_file():
            raise ConfigError(f"{quoted(name)}: there is no such recording")
        return path

    def shortened(self, text: str) -> str:
        """Return a message with names of files in place of their paths in the folder."""
        for folder in {str(self.folder.absolute()), str(self.folder)} - {"."}:
            text = text.replace(f"{folder}{os.sep}", "")
        return text

    def delete(self, name: str) -> None:
        """Remove a file for good.

        Raises:
            ConfigError: If it is not there, or cannot be removed.
        """
        path = self.find(name)
        try:
            path.unlink()
        except OSError as error:
            raise ConfigError(f"{path.name}: {error.strerror}; it cannot be deleted") from None

    def receive(self, name: object, offset: int, data: bytes, *, last: bool) -> str | None:
        """Append a piece of a file that a browser sends; the first piece starts the file.

        Returns:
            Name of the file after the last piece: another one if the given one was taken.

        Raises:
            ConfigError: If the name is invalid, a piece is missing, or the disk is full.
        """
        checked = _checked(name)
        if Path(checked).suffix.lower() not in (RECORDING, DATABASE) and not is_log(checked):
            logs = ", ".join(dict.fromkeys((*CAN_LOGS, *EITHER, *tables())))
            raise ConfigError(
                f"{quoted(checked)}: is neither a recording (.rrd), a log ({logs}, or .csv.gz) nor a "
                "database (.dbc); export it as one of these"
            )
        part = self.folder / f".{checked}{PART}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if Disk(self.folder).free() < len(data):
                raise ConfigError(f"{checked}: the disk is nearly full; make room and drop it again")
            if offset == 0:
                part.unlink(missing_ok=True)
            flags = os.O_WRONLY | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
            handle = os.open(part, flags | (os.O_CREAT | os.O_EXCL if offset == 0 else 0), 0o666)
            with os.fdopen(handle, "ab") as file:
                if os.fstat(file.fileno()).st_size != offset:
                    raise ConfigError(f"{checked}: a piece of it is missing; drop it again")
                file.write(data)
            return self._keep(part, checked) if last else None
        except OSError as error:
            raise ConfigError(f"{checked}: {error.strerror}; it cannot be kept in {self.folder}") from None

    def _keep(self, part: Path, name: str) -> str:
        """Rename a complete file to its name, or to the next one that is free."""
        stem, dot, rest = name.partition(".")
        for k in range(1, 1000):
            free = self.folder / (name if k == 1 else f"{stem}-{k}{dot}{rest}")
            try:
                # A link fails where a rename would replace.
                os.link(part, free)
            except FileExistsError:
                continue
            part.unlink()
            return free.name
        raise ConfigError(f"{name}: there are too many of that name; delete some")


def is_log(name: str) -> bool:
    """Return whether a file of this name can be a log; a text of another folder need not be one, see `is_recording`."""
    return is_recording(name) or suffix_of(Path(name)) in EITHER


def _checked(name: object) -> str:
    """Return a name that can only mean a file directly in the folder.

    Raises:
        ConfigError: If it could mean another one.
    """
    if not isinstance(name, str) or not name:
        raise ConfigError("name is missing; give that of a file in the folder of recordings")
    plain = name == Path(name).name and not set(name) & set('/\\:*?"<>|')
    if not plain or name.startswith(".") or not name.isprintable() or len(os.fsencode(name)) > MAX_NAME_BYTES:
        raise ConfigError(f"{quoted(name)} is no name of a file in the folder of recordings")
    return name
