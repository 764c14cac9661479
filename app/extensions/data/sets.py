"""The table of recordings (sets.yaml): source, licence, size and files of each."""

from __future__ import annotations

import os
import shlex
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, urlsplit

import yaml

from app.result import JsonObject
from app.twin.sources.kind import recordings_folder
from estimators.errors import ConfigError, nearest

SERVER = "https://raw.githubusercontent.com"

MIRROR = "NISUS_MIRROR"  # Environment variable with the address of a copy of `SERVER`


@dataclass(frozen=True)
class SourceFile:
    """File of a source: its URL, its name in the recording, its size and SHA-256."""

    url: str
    to: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class RecordingSet:
    """Recorded data of some bundled twins, and its folder on this machine; sets.yaml describes the fields."""

    name: str
    folder: Path
    twins: list[str]
    licence: str
    source: str
    files: list[SourceFile]
    makes: list[str]
    convert: str | None = None
    table: str | None = None
    file: str = ""
    refused: str | None = None
    csv: dict[str, tuple[str, str]] = field(default_factory=dict)
    means: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def bytes(self) -> int:
        """Size of the files of the source."""
        return sum(file.bytes for file in self.files)

    @property
    def parts(self) -> Path:
        """Folder of files that are being downloaded and converted."""
        return self.folder.with_name(f".{self.name}")

    @property
    def lacking(self) -> list[str]:
        """Files that the twins read and that are not on this machine."""
        return [name for name in self.makes if not (self.folder / name).is_file()]

    @property
    def by_hand(self) -> str | None:
        """Instruction for a recording that is not downloaded; None for all others."""
        command = f"nisus data get {self.twins[0]} --file {shlex.quote(self.file)}"
        return self.refused and f"{self.refused}; download {self.file} from {self.source} and give it: {command}"

    def progress(self) -> str:
        """Return the downloaded size, and that of the whole."""
        size = 0
        with suppress(OSError):  # a file that is moved away meanwhile
            for path in self.parts.rglob("*"):
                size += path.stat().st_size if path.is_file() else 0
        return f"{size_text(min(size, self.bytes))} of {size_text(self.bytes)}"

    def as_json(self) -> JsonObject:
        """Return the facts that a user needs before a download."""
        facts = {name: getattr(self, name) for name in ("name", "twins", "bytes", "licence", "source", "by_hand")}
        host = urlsplit(self.files[0].url).netloc
        return {**facts, "host": host, "folder": str(self.folder), "present": not self.lacking}


def recordings() -> dict[str, RecordingSet]:
    """Return all recordings by name."""
    server = (os.environ.get(MIRROR) or SERVER).rstrip("/")
    table = yaml.load(Path(__file__).with_name("sets.yaml").read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    for fields in table.values():
        fields["files"] = [SourceFile(f"{server}/{quote(file.pop('url'))}", **file) for file in fields["files"]]
        fields.setdefault("makes", [file.to for file in fields["files"]])
    return {name: RecordingSet(name, recordings_folder() / name, **fields) for name, fields in table.items()}


def find(name: str) -> RecordingSet:
    """Return a recording by its name or that of one of its twins.

    Raises:
        ConfigError: If there is none.
    """
    named = {key: found for found in recordings().values() for key in (found.name, *found.twins)}
    if name not in named:
        raise ConfigError(f"{name}: no recording and no twin with one has this name; {nearest(name, named)}")
    return named[name]


def size_text(size: float) -> str:
    """Return a number of bytes in kB or MB."""
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.0f} kB"
