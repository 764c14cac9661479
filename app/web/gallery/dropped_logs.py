"""Dropped logs: their signals, the twins that fit, and drafts of twins, each worked out in a reader process."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

from config.source_schema import CanLogSection, CanSection
from estimators.errors import ConfigError, SourceError
from sources.worker_process import IsolatedReader

from ...engine.jobs import CANCELLED, CANCELLING, DONE, FAILED, RUNNING, Job
from ...result import JsonObject
from ...study.advice.draft import check_new
from ...study.advice.draft_fit import DraftStep
from ...study.advice.plan import YAML_NAME
from ...study.log_overview import LogOverview, draft, how_to_read, overview
from ...twin.log_match import LogHeader, TwinMatch, match_log
from ...twin.source import KEY, kind_of
from ...twin.sources.kind import find_databases
from ..running import stamp_of
from .cards import Card, readable_twins
from .recordings import DATABASE, Recordings

JOB_TIMEOUT_S = 600.0  # Longest time between two items of a job; the page shows how long it has taken

OPTION_WORDS = {
    " with --inputs": "", " with --sensors": "", " with --signals": "", " (decimal of the source)": "",
    "name it with --dbc": "let its name end in .dbc", " with --dbc": "", "with --time-zone": "as Zone",
    "--hold-out ": "held out: ", "--inputs ": "input: ", "--sensors ": "sensor: ", "--states ": "state: ",
    " with --time": "", "--signals ": "signal: ", "--time ": "column ", "add --time-unit": "choose --time-unit",
    f"nisus advise {YAML_NAME} --apply": "Advice", f"nisus tune {YAML_NAME}": "Tune",
}  # fmt: skip
"""Options and commands in messages of the command line, as the page has them; other ones are fields (`FIELD`)."""

FIELD = re.compile(r"(?:(?<=\()[\w.]+, )?--(?:time-)?(unit|zone|format|heading|delimiter|decimal|skip|sheet)")
"""Option, with its key of a twin, whose field on the page has the same name."""

STOPPED_STATES = {CANCELLING: RUNNING, CANCELLED: "stopped"}  # States of a job whose names on the page differ

MAX_CURVES = 200  # Curves of one answer

MAX_KEPT_LOGS = 2  # Overviews that are kept


@dataclass(frozen=True)
class LogRequest:
    """A log, and how to read it: DBC files by name (None: those that fit), and the keys of a source."""

    name: str
    dbc: tuple[str, ...] | None = None
    time: str | None = None
    unit: str = "s"
    format: str | None = None
    zone: str | None = None
    heading: str | None = None
    delimiter: str | None = None
    decimal: str | None = None
    skip: int = 0
    sheet: str | None = None


@dataclass(frozen=True, kw_only=True)
class CurvesRequest(LogRequest):
    """Signals of a log, by index, whose curves are wanted."""

    signals: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class DraftRequest(LogRequest):
    """Name of a twin to draft from a log, and indices of the signals in each of `app.study.advice.plan.Roles`."""

    twin: str
    roles: dict[Literal["states", "sensors", "inputs", "held_out"], tuple[int, ...]]


class ReaderJob(Job):
    """A generator of a reader process, run in a thread; `item` is the last one that it yielded."""

    def __init__(
        self,
        function: Callable[..., Iterator[object]],
        path: Path,
        *args: object,
        then: Callable[..., None] = lambda item: None,
    ) -> None:
        """Begin `function(path, *args)`, importable by name; `then` gets the last item, in the job's thread."""
        super().__init__(path.name, lambda job: self._read(function, path, args))
        self.item: Any = None
        self.answer: tuple[object, JsonObject] = (None, {})  # of the item that is first
        self._then = then
        threading.Thread(target=self.run, name="log", daemon=True).start()

    @property
    def error(self) -> str | None:
        """Why it failed, with the name of the log; None unless it did."""
        if self.state != FAILED:
            return None
        return self.reason if self.name in self.reason else f"{self.name}: {self.reason}"

    def _read(self, function: Callable[..., Iterator[object]], path: Path, args: tuple[object, ...]) -> None:
        try:
            with closing(IsolatedReader(function, path, *args, timeout=JOB_TIMEOUT_S, keep=False)) as reader:
                while not reader.ended:
                    self.check()
                    item = reader.get(0.2)
                    self.item = self.item if item is None else item
            self.check()
            self._then(self.item)
        except OSError as error:
            raise SourceError(str(error)) from None


class DroppedLogs:
    """Reads one log at a time, and keeps the overviews of the last ones."""

    def __init__(self, recordings: Recordings, names: Callable[[], Sequence[str]], run: Callable[[str], None]) -> None:
        """Take the folder of recordings, the names of all twins, and a function that runs a drafted twin."""
        self._recordings, self._names, self._run = recordings, names, run
        self._draft: tuple[str, ReaderJob] | None = None
        self._lock = threading.Lock()
        self._jobs: dict[tuple[object, ...], ReaderJob] = {}

    def read(self, wanted: LogRequest) -> tuple[Path, ReaderJob]:
        """Return the file and the job that reads it, which begins unless it is there; another one ends.

        Raises:
            ConfigError: If there is no such file, or an option is wrong.
        """
        path = self._recordings.find(wanted.name)
        offered = self.databases()
        given = None if wanted.dbc is None else [self._database(name, offered) for name in wanted.dbc]
        args = (given, list(offered), how_to_read(wanted))
        key = (str(path), stamp_of((path, *offered)), *map(str, args))
        with self._lock:
            if key not in self._jobs:
                for job in self._jobs.values():
                    job.cancel()
                done = [(other, job) for other, job in self._jobs.items() if job.state == DONE]
                self._jobs = dict(done[1 - MAX_KEPT_LOGS :])
                self._jobs[key] = ReaderJob(overview, path, *args)
            return path, self._jobs[key]

    def state(self, wanted: LogRequest) -> JsonObject:
        """Return how far the log has been read, its signals, and the twins by how well they fit."""
        path, job = self.read(wanted)
        # In this order: once it has ended, its item is the last one.
        running, item, error = not job.over, job.item, self._words(job.error or "")
        if running and item is None:
            return {"name": path.name, "state": "reading", "seconds": job.elapsed}
        if item is None:
            return {"name": path.name, "state": "failed", "error": error}
        if job.answer[0] is not item:
            job.answer = item, self._answer(path, item)
        return {**job.answer[1], "proposing": running, "unproposed": error}

    def _answer(self, path: Path, found: LogOverview) -> JsonObject:
        answer, owners = found.as_json(), self.databases()
        answer["databases"] = [
            asdict(one) | {"file": "", "name": _label(one.file, self._recordings.folder), "twins": owners[one.file]}
            for one in found.databases
            if one.file in owners and (one.ids or not owners[one.file])
        ]
        answer["faults"] = [self._words(text) for text in found.faults]
        header = LogHeader(
            found.kind,
            frozenset(found.keys),
            dict.fromkeys(found.choices, "") | {one.name: one.unit for one in found.signals},
            found.texts,
            found.time,
        )
        answer["twins"] = [] if found.needs == "time" else self.twins(header)
        return {"name": path.name, "state": "ready", "draft_name": self._free_name(path), **answer}

    def draft(self, wanted: DraftRequest) -> JsonObject:
        """Begin to draft a twin from a log, which then runs; return the progress.

        Raises:
            ConfigError: If another draft is under way, or a name or role does not apply.
        """
        path, job = self.read(wanted)
        found: LogOverview | None = job.item
        if found is None or not found.signals:
            raise ConfigError(f"{path.name}: no signals are known yet; wait until it is read")
        if self._draft is not None and not self._draft[1].over:
            raise ConfigError(f"{self._draft[0]} is being drafted; wait for it or stop it")
        check_new(wanted.twin, path.parent)
        named: dict[str, list[str]] = {}
        for role, indices in wanted.roles.items():
            if not all(0 <= k < len(found.signals) for k in indices):
                raise ConfigError(f"{role}: give indices below {len(found.signals)}")
            picked = [found.signals[k] for k in indices]
            named[role] = [f"{one.group}.{one.name}" if found.kind == "can_log" else one.name for one in picked]
        if not named.get("states") and not named.get("sensors"):
            raise ConfigError("no signal is a state or a sensor; give at least one this role")
        how = how_to_read(replace(wanted, time=found.time))
        args = ([one.file for one in found.databases if one.used], how, wanted.twin, named)
        self._draft = wanted.twin, ReaderJob(draft, path, *args, then=lambda step: self._run(step.file))
        return self.drafting()

    def drafting(self) -> JsonObject:
        """Return the progress of the draft."""
        if self._draft is None:
            return {"state": "none"}
        twin, job = self._draft
        step: DraftStep = job.item or DraftStep("starting")
        error = None if job.error is None else self._words(job.error)
        state = STOPPED_STATES.get(job.state, job.state)
        known = {"doing": step.doing, "summary": self._words(step.summary)}
        return {"state": state, "twin": twin, "seconds": job.elapsed, "error": error, **known}

    def stop_draft(self) -> JsonObject:
        """Stop the draft under way; return the progress."""
        if self._draft is not None:
            self._draft[1].cancel()
        return self.drafting()

    def _words(self, text: str) -> str:
        """Return a message without paths and options of the command line."""
        text = self._recordings.shortened(text)
        for option, words in OPTION_WORDS.items():
            text = text.replace(option, words)
        return FIELD.sub(lambda found: found[1].capitalize(), text)

    def _free_name(self, path: Path) -> str:
        """Return a name for a twin of a log that is not taken."""
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", path.name.partition(".")[0]).strip("_-") or "log"
        stem = stem if stem[0].isalpha() else f"log_{stem}"
        taken = {Path(name).stem for name in self._names()}
        taken |= {file.stem for ending in ("yaml", "py") for file in path.parent.glob(f"*.{ending}")}
        return next(name for k in count(1) if (name := stem if k == 1 else f"{stem}-{k}") not in taken)

    def curves(self, wanted: CurvesRequest) -> dict[str, list[list[list[float]]]]:
        """Return decimated curves of signals of a log that was read: seconds, lowest and highest values.

        Raises:
            ConfigError: If the log has not been read, or there is no such signal.
        """
        found = self.read(wanted)[1].item
        if found is None:
            raise ConfigError(f"{wanted.name}: is still being read; ask again")
        if len(wanted.signals) > MAX_CURVES or not all(0 <= k < len(found.curves) for k in wanted.signals):
            raise ConfigError(f"signals: give at most {MAX_CURVES} indices below {len(found.curves)}")
        return {"curves": [[part.tolist() for part in found.curves[k]] for k in wanted.signals]}

    def databases(self) -> dict[Path, list[str]]:
        """Return the DBC files in the folder, and those of the twins, with the names of the twins that use them."""
        folder = self._recordings.folder
        inside = [path for path in sorted(folder.glob("[!.]*")) if path.suffix.lower() == DATABASE]
        found: dict[Path, list[str]] = {path: [] for path in inside if path.is_file() and not path.is_symlink()}
        for card, loaded, _ in readable_twins(self._names()):
            section = loaded.config.source
            for key, part in kind_of(section.type).sections(section, KEY).items():
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

    def twins(self, header: LogHeader) -> list[JsonObject]:
        """Return all twins, those first that fit a log best, with their matched and missing channels."""
        found = [(match_log(loaded, model, header), card) for card, loaded, model in readable_twins(self._names())]
        found.sort(key=lambda item: (not item[0].runs, -item[0].share, len(item[0].missing), item[1].name))
        return [_twin_json(match, card) for match, card in found]


def _twin_json(match: TwinMatch, card: Card) -> JsonObject:
    own = {"name": card.name, "short": Path(card.name).stem, "title": card.title}
    return own | {"runs": match.runs, "share": match.share} | asdict(match)


def _label(path: Path, folder: Path) -> str:
    """Return the name of a DBC on the page; one outside the folder of recordings has its own folder before it."""
    return path.name if path.parent.absolute() == folder.absolute() else f"{path.parent.name}/{path.name}"
