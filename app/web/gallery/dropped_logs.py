"""Dropped logs: their signals, the twins that fit, and drafts of twins, each worked out in a reader process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from config.source_schema import CanLogSection, CanSection
from estimators.errors import ConfigError, NisusError, SourceError
from sources.tables.times import SERIAL_DAYS, UNITS, TimeColumn
from sources.worker_process import IsolatedReader

from ...studies.log_overview import LogOverview, overview
from ...twin.log_match import LogHeader, TwinMatch, match_log
from ...twin.source import KEY, SOURCES
from ...twin.sources.kind import find_databases
from ..running import stamp_of
from .cards import Card, readable_twins
from .recordings import DATABASE, Recordings

MAX_CURVES = 200  # Curves of one answer

MAX_KEPT_LOGS = 2  # Overviews that are kept


@dataclass(frozen=True)
class LogRequest:
    """A log, and how to read it: DBC files by name (None: those that fit), time column, its unit and zone."""

    name: str
    dbc: tuple[str, ...] | None = None
    time: str | None = None
    unit: str = "s"
    zone: str | None = None


class ReaderJob:
    """A generator of a reader process, run in a thread; `item` is what it yielded last."""

    def __init__(self, function: Callable[..., Iterator[Any]], path: Path, *args: Any) -> None:
        self.item: Any = None
        self.answer: dict[str, Any] | None = None
        self.error: str | None = None
        self.state = "running"
        self._begun = time.monotonic()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, args=(function, path, args), name="log", daemon=True)
        self._thread.start()

    @property
    def seconds(self) -> float:
        """Seconds since its start."""
        return round(time.monotonic() - self._begun, 1)

    def stop(self) -> None:
        """End it, with its process, soon."""
        self._stopping = True

    def _run(self, function: Callable[..., Iterator[Any]], path: Path, args: tuple[Any, ...]) -> None:
        try:
            reader = IsolatedReader(function, path, *args, keep=False)
            try:
                while not reader.ended and not self._stopping:
                    item = reader.take(0.2)
                    self.item = self.item if item is None else item
            finally:
                reader.close()
            self.state = "done"
        except (NisusError, OSError) as error:
            text = str(error)
            self.error = text if path.name in text else f"{path.name}: {text}"
            self.state = "failed"


class DroppedLogs:
    """Reads one log at a time, and keeps the overviews of the last ones."""

    def __init__(self, recordings: Recordings, names: Callable[[], Sequence[str]]) -> None:
        """Take the folder of recordings, and the names of all twins."""
        self._recordings, self._names = recordings, names
        self._lock = threading.Lock()
        self._jobs: dict[Any, ReaderJob] = {}

    def read(self, wanted: LogRequest) -> tuple[Path, ReaderJob]:
        """Return the file and the job that reads it, which begins unless it is there; another one ends.

        Raises:
            ConfigError: If there is no such file, or the unit is unknown.
        """
        path = self._recordings.find(wanted.name)
        if wanted.unit not in (*UNITS, *SERIAL_DAYS):
            raise ConfigError(
                f"unit {wanted.unit!r} is no unit of time; choose from {', '.join((*UNITS, *SERIAL_DAYS))}"
            )
        offered = self.databases()
        given = None if wanted.dbc is None else [self._database(name, offered) for name in wanted.dbc]
        column = TimeColumn(wanted.time or "", wanted.unit, None, wanted.zone)
        args = (given, list(offered), column)
        key = (str(path), stamp_of((path, *offered)), *map(str, args))
        with self._lock:
            if key not in self._jobs:
                for job in self._jobs.values():
                    job.stop()
                done = [(other, job) for other, job in self._jobs.items() if job.state == "done"]
                self._jobs = dict(done[1 - MAX_KEPT_LOGS :])
                self._jobs[key] = ReaderJob(overview, path, *args)
            return path, self._jobs[key]

    def state(self, wanted: LogRequest) -> dict[str, Any]:
        """Return how far the log has been read, its signals, and the twins by how well they fit."""
        path, job = self.read(wanted)
        if job.state == "running" and job.item is None:
            return {"name": path.name, "state": "reading", "seconds": job.seconds}
        if job.item is None:
            return {"name": path.name, "state": "failed", "error": _short(job.error or "", path)}
        if job.answer is None:
            job.answer = self._answer(path, job.item)
        return job.answer

    def _answer(self, path: Path, found: LogOverview) -> dict[str, Any]:
        answer = found.as_json()
        owners = self.databases()
        answer["databases"] = [
            {**asdict(one), "name": _label(Path(one.file), self._recordings.folder), "twins": owners[Path(one.file)]}
            for one in found.databases
            if Path(one.file) in owners and (one.ids or not owners[Path(one.file)])
        ]
        for one in answer["databases"]:
            one["used"] = one["file"] in found.used
        answer["faults"] = [_short(text, path) for text in found.faults]
        header = LogHeader(
            found.kind,
            frozenset(found.keys),
            {one.name: one.unit for one in found.signals},
            {name: [text.rpartition(" (")[0] for text in texts] for name, texts in found.texts.items()},
            found.time,
        )
        answer["twins"] = [] if found.needs == "time" else self.twins(header)
        return {"name": path.name, "state": "ready", **answer}

    def curves(self, wanted: LogRequest, signals: Sequence[int]) -> list[list[list[float]]]:
        """Return curves of signals by their index: seconds, lowest and highest values.

        Raises:
            ConfigError: If the log has not been read, or there is no such signal.
        """
        _, job = self.read(wanted)
        found = job.item
        if found is None:
            raise ConfigError(f"{wanted.name}: is still being read; ask again")
        if len(signals) > MAX_CURVES or not all(0 <= k < len(found.curves) for k in signals):
            raise ConfigError(f"signals: give at most {MAX_CURVES} indices below {len(found.curves)}")
        return [[part.tolist() for part in found.curves[k]] for k in signals]

    def databases(self) -> dict[Path, list[str]]:
        """Return the DBC files in the folder, and those of the twins, with the names of the twins that use them."""
        folder = self._recordings.folder
        found: dict[Path, list[str]] = {}
        if folder.is_dir():
            inside = [path for path in sorted(folder.iterdir()) if path.suffix.lower() == DATABASE]
            found = {path: [] for path in inside if path.is_file() and not path.is_symlink() and path.name[0] != "."}
        for card, loaded, _ in readable_twins(self._names()):
            section = loaded.config.source
            for key, part in SOURCES[section.type].sections(section, KEY).items():
                if isinstance(part, CanSection | CanLogSection):
                    with suppress(SourceError):  # its recording is not on this machine
                        for path, _ in find_databases(loaded, part, key):
                            if folder / path.name not in found or path.parent == folder:
                                found.setdefault(path, []).append(Path(card.name).stem)
        return found

    def _database(self, name: str, offered: dict[Path, list[str]]) -> Path:
        for path in offered:
            if name == _label(path, self._recordings.folder):
                return path
        raise ConfigError(f"{name}: there is no such DBC; drop it on the page")

    def twins(self, header: LogHeader) -> list[dict[str, Any]]:
        """Return all twins, those first that fit a log best, with their matched and missing channels."""
        found = [(match_log(loaded, model, header), card) for card, loaded, model in readable_twins(self._names())]
        found.sort(key=lambda item: (not item[0].runs, -item[0].share, len(item[0].missing), item[1].name))
        return [_twin_json(match, card) for match, card in found]


def _twin_json(match: TwinMatch, card: Card) -> dict[str, Any]:
    lines = {key: list(getattr(match, key)) for key in ("found", "missing")}
    own = {"name": card.name, "short": Path(card.name).stem, "title": card.title}
    return {**own, "runs": match.runs, "share": match.share, "blocking": match.blocking, **lines}


def _label(path: Path, folder: Path) -> str:
    """Return the name of a DBC on the page; one outside the folder of recordings has its own folder before it."""
    return path.name if path.parent.absolute() == folder.absolute() else f"{path.parent.name}/{path.name}"


def _short(text: str, path: Path) -> str:
    """Return a message with the file's name in place of its path."""
    return text.replace(str(path.parent.absolute()) + "/", "").replace(f"{path.parent}/", "")
