"""Regression suite: archived recordings folded with their accepted tunings, and compared with recorded figures."""

from __future__ import annotations

import contextlib
import json
import os
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from app.result import JsonObject, Topic
from app.study.compare import draws, tidy, within
from app.study.processes import results
from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin, restore_twin
from app.twin.versions import COVERAGE, RMSE, VERDICT_FILE, last_accepted, now, verdicts
from config.companion_schema import AcceptedSection
from config.loader import find, shipped
from config.source_schema import SimulatorSection
from config.tunings import OWN_VALUES, Version, folders, load_version, named, ships, version_files
from config.yaml_files import shown_path, yaml_files
from estimators.errors import ConfigError, NisusError, SourceError, printable
from estimators.fold import Fold
from estimators.log import Log
from estimators.registry import find_entry
from estimators.snapshots import Base
from estimators.tuning import Tuning

from .baseline import (
    ComparedFigure,
    allowances,
    compare_figures,
    fingerprint,
    fold_figures,
    read_baseline,
    write_baseline,
)
from .schema import FigureSection, ReferenceSection

SIMULATED_LOGS = 3  # logs of a simulated asset, with consecutive seeds

SEEDS, SEEDS_PER_LOG = 8, 4
"""Folds of a filter that draws, with consecutive seeds: of a single log, and of each of several."""

BUDGET_S = 15.0  # processor seconds for all folds of a recording; a shorter span of a longer one is guarded
FIRST_SPAN_S = 10.0  # seconds of the first part of a recording that is timed
SUFFIX = ".guard.yaml"  # end of the name of a baseline file beside a twin


@dataclass(frozen=True)
class GuardedLog:
    """A twin with the log of its own source, or of a recording.

    `reference` is its baseline file, `writes` where a new baseline is written, which may hide it; `failure` says why a
    recording cannot be read.
    """

    name: str
    twin: Path
    recording: Path | None
    reference: Path
    writes: Path
    failure: str = ""

    @property
    def version(self) -> Version | None:
        """Tuning version that it is folded with; None means the twin's file."""
        return accepted_version(self.twin)


@dataclass(frozen=True)
class GuardVerdict:
    """Compared figures of one log, or why there are none: `failure`, or `absent` if the recording is missing."""

    name: str
    version: str = ""
    compared: Sequence[ComparedFigure] = ()
    failure: str = ""
    absent: str = ""
    seconds: float = 0.0


def accepted_version(twin: Path) -> Version | None:
    """Return the tuning version that guards fold a twin with; None for its own file."""
    return last_accepted(map(load_version, version_files(twin).values()))


def of_twin(name: str) -> GuardedLog:
    """Return a twin with the log of its source.

    The baseline of a bundled twin is bundled too, but beside the user's versions if one of those is accepted; the
    baseline of any other twin is beside its file.
    """
    twin = find(name)
    if not ships(twin):
        own = twin.with_name(f"{twin.stem}{SUFFIX}")
        return GuardedLog(twin.stem, twin, None, own, own)
    bundled = Path(__file__).with_name("baselines") / f"{twin.stem}.yaml"
    folder = folders(twin)[0]
    version = accepted_version(twin)
    if version is None or version.path.parent != folder:
        return GuardedLog(twin.stem, twin, None, bundled, bundled)
    own = folder.parent.parent / "guard" / f"{twin.stem}.yaml"
    return GuardedLog(twin.stem, twin, None, own if own.is_file() else bundled, own)


def of_folder(folder: Path) -> list[GuardedLog]:
    """Return the twins and the recordings of a folder.

    Raises:
        ConfigError: If there are none.
    """
    twins = [of_twin(str(path)) for path in yaml_files(folder) if not path.name.endswith(SUFFIX)]
    recordings = [_of_recording(path) for path in sorted(folder.glob("*.rrd"))]
    if not twins and not recordings:
        raise ConfigError(f"--archive {folder}: holds no recording (.rrd) and no twin (.yaml); name their folder")
    return twins + recordings


def _of_recording(path: Path) -> GuardedLog:
    own = path.with_name(f"{path.stem}{SUFFIX}")
    try:
        from app.record.reader import read_recording

        twin = read_recording(path).twin_path
    except SourceError as error:
        return GuardedLog(path.stem, path, path, own, own, str(error))
    return GuardedLog(path.stem, twin, path, own, own)


def chosen(names: Sequence[str], folder: Path | None) -> list[GuardedLog]:
    """Return the named twins, those of a folder, or all bundled twins that have a baseline."""
    found = [of_twin(name) for name in names]
    if folder is not None:
        found += of_folder(folder)
    return found or [guarded for guarded in map(of_twin, shipped()) if guarded.reference.is_file()]


def guard_all(
    logs: Sequence[GuardedLog],
    note: str | None,
    overrides: Mapping[str, str],
    advance: Callable[[], None],
    *,
    jobs: int | None = None,
    cluster: str | None = None,
) -> list[GuardVerdict]:
    """Guard every log, in parallel; `advance` is called after each. See `guard_log` and `results`."""
    found: dict[int, GuardVerdict] = {}
    for k, verdict in results(guard_log, [(each, note, overrides) for each in logs], jobs=jobs, cluster=cluster):
        found[k] = verdict
        advance()
    return [found[k] for k in range(len(logs))]


def guard_log(guarded: GuardedLog, note: str | None = None, overrides: Mapping[str, str] | None = None) -> GuardVerdict:
    """Fold a log, compare its figures with the baseline, and record a new baseline if there is a `note`."""
    begun = time.monotonic()
    verdict = GuardVerdict(guarded.name)
    try:
        if guarded.failure:
            raise SourceError(guarded.failure)
        twin = twin_of(guarded, dict(overrides or {}))
        verdict = replace(verdict, version=twin.tuning.name)
        known = read_baseline(guarded.reference)
        if known is None and note is None:
            words = (
                named(guarded.twin) if (held := guarded.recording) is None else f"--archive {shown_path(held.parent)}"
            )
            text = f"no figures are recorded; `nisus guard {words} --accept --note ...` records them"
            return replace(verdict, absent=text)
        span = known.span if known is not None else _span(guarded, twin)
        measured = measure(guarded, twin, span, note)
        if note is not None:
            write_baseline(guarded.writes, guarded.name, measured)
        if known is not None:
            compared = compare_figures(known, measured, simulated=is_simulated(guarded, twin))
            verdict = replace(verdict, compared=compared)
    except SourceError as error:
        missing = "is not there" in str(error)
        verdict = replace(verdict, absent=str(error) if missing else "", failure="" if missing else str(error))
    except NisusError as error:
        verdict = replace(verdict, failure=str(error))
    return replace(verdict, seconds=time.monotonic() - begun)


def twin_of(guarded: GuardedLog, overrides: dict[str, str] | None = None) -> Twin:
    """Return the twin with its accepted version; if the twin of a recording is gone, as recorded."""
    version = guarded.version
    given = {**(overrides or {}), "tuning": OWN_VALUES if version is None else str(version.path)}
    if guarded.recording is None:
        return load_twin(guarded.twin, overrides=given)
    from app.record.reader import read_recording

    recorded = read_recording(guarded.recording)
    own = {key: value for key, value in recorded.overrides.items() if key != "tuning"}
    if guarded.twin.is_file():
        return load_twin(guarded.twin, overrides={**own, **given})
    return restore_twin(recorded.text, recorded.twin_path, own)


def is_simulated(guarded: GuardedLog, twin: Twin) -> bool:
    """Return whether its logs are simulated anew each time."""
    return guarded.recording is None and isinstance(twin.config.source, SimulatorSection)


def folds_of(guarded: GuardedLog, twin: Twin) -> tuple[int, int]:
    """Return the number of logs, and of folds of each."""
    logs = SIMULATED_LOGS if is_simulated(guarded, twin) else 1
    if not draws(find_entry(twin.estimator)):
        return logs, 1
    return logs, SEEDS if logs == 1 else SEEDS_PER_LOG


def logs_of(guarded: GuardedLog, twin: Twin, span: float | None) -> Iterator[tuple[Log, Base | None]]:
    """Yield each log of a twin (`twin_of`), `span` seconds of it (None: all), and where its folds start.

    Raises:
        SourceError: If a recording is missing or cannot be read.
    """
    if guarded.recording is not None:
        from app.record.reader import read_recording

        recorded = read_recording(guarded.recording)
        yield Log.resume(twin.model, None, within(recorded.events, span)), recorded.base_for(twin.model)[0]
        return
    source = twin.config.source
    if not isinstance(source, SimulatorSection):
        yield read_log(twin, span)[0], None
        return
    for k in range(SIMULATED_LOGS):
        yield read_log(twin_of(guarded, {"source.seed": str(source.seed + k)}), span)[0], None


def measure(guarded: GuardedLog, twin: Twin, span: float | None, note: str | None) -> ReferenceSection:
    """Return all figures of a log; `twin` and `span` are those of `logs_of`.

    `note` is the reason for recording them; None if they are only compared, which needs no allowances.

    Raises:
        NisusError: If it cannot be folded.
    """
    logs, values, allowed = [], [], []
    _, seeds = folds_of(guarded, twin)
    for log, base in logs_of(guarded, twin, span):
        logs.append(fingerprint(log))
        for seed in range(seeds):
            folds = _folds(twin, log, base, seed)
            values.append(_joined(folds, fold_figures))
            allowed.append(_joined(folds, allowances) if note is not None else dict.fromkeys(values[-1], 0.0))
    return ReferenceSection(
        accepted=AcceptedSection(at=now(), note=note or ""),
        version=twin.tuning.name,
        estimator=twin.estimator,
        seeds=seeds,
        span=span,
        events=tuple(count for count, _ in logs),
        sums=tuple(total for _, total in logs),
        # A figure must exist for every log.
        figures={
            name: FigureSection(
                values=tuple(each[name] for each in values), allowed=tuple(each[name] for each in allowed)
            )
            for name in values[0]
            if all(name in each for each in values)
        },
    )


def _folds(twin: Twin, log: Log, base: Base | None, seed: int) -> list[Fold]:
    """Fold a log; where no truth is known, also with each sensor in turn held out."""
    found = [_folded(twin, twin.tuning, log, base, seed)]
    if any(name.startswith(f"{RMSE}.") for name in fold_figures(found[0])):
        return found
    names = [twin.model.sensor_names[k] for k in twin.plan.fed]
    without = [twin.tuning.set(f"use.{name}", False) for name in names if len(names) > 1]
    return found + [_folded(twin, tuning, log, base, seed) for tuning in without]


def _joined(folds: Sequence[Fold], measured: Callable[[Fold], dict[str, float]]) -> dict[str, float]:
    """Return the figures of the first fold, and the errors of the sensors that the others hold out."""
    first, *others = map(measured, folds)
    kinds = (f"{RMSE}.", f"{COVERAGE}.")
    return first | {name: value for each in others for name, value in each.items() if name.startswith(kinds)}


def _folded(twin: Twin, tuning: Tuning, log: Log, base: Base | None, seed: int) -> Fold:
    fold = _fold(twin, tuning, log, base, seed)
    fold.advance()
    fold.finish()
    if fold.failure is not None:
        raise fold.failure
    return fold


def _fold(twin: Twin, tuning: Tuning, log: Log, base: Base | None, seed: int) -> Fold:
    tuning = replace(tuning, seed=seed)
    return Fold(twin.estimator, twin.model, tuning, log, base=base, policy=twin.policy, expected=twin.expected)


def _span(guarded: GuardedLog, twin: Twin) -> float | None:
    """Return the seconds that can be simulated and folded within the budget; None means all.

    Longer and longer parts are timed, since all of a large asset would take much longer than the budget.
    """
    logs, seeds = folds_of(guarded, twin)
    part = FIRST_SPAN_S
    while True:
        begun = time.process_time()
        log, base = next(logs_of(guarded, twin, part))
        # Reading a recording takes equally long for any part of it.
        read = time.process_time() - begun if is_simulated(guarded, twin) else 0.0
        fold = _fold(twin, twin.tuning, log, base, 0)
        fold.advance(1)  # loads compiled code
        begun = time.process_time()
        fold.advance()
        needed = logs * (read + seeds * (time.process_time() - begun))
        seconds = log.events.seconds
        if needed > BUDGET_S:
            return tidy(seconds * BUDGET_S / needed)
        if seconds < 0.5 * part:
            return None
        part *= 4.0


def guard_topics(found: Sequence[GuardVerdict], absent_fails: bool) -> list[Topic]:
    """Return the sum, the figures that got worse or better, and logs that failed or are missing."""
    worse = [(each, figure) for each in found for figure in each.compared if figure.worse]
    better = [(each, figure) for each in found for figure in each.compared if figure.better]
    folded = sum(not each.failure and not each.absent for each in found)
    count = sum(len(each.compared) for each in found)
    sentences = [f"{folded} recordings, {count} figures: {len(worse)} worse, {len(better)} better"]
    if better and not worse:
        sentences.append("Guard the better figures from now on with --accept --note ...")
    topics = [Topic("Guard", tuple(sentences))]
    head = ("recording", "tuning", "figure", "was", "is", "change", "allowed")
    for title, some in (("Worse than the baseline", worse), ("Better than the baseline", better)):
        rows = tuple(
            (
                each.name,
                each.version,
                figure.figure if not figure.log else f"{figure.figure} (log {figure.log})",
                f"{figure.before:.6g}",
                f"{figure.now:.6g}",
                f"{figure.change:+.3g}",
                f"{figure.allowed:.2g}",
            )
            for each, figure in some
        )
        if rows:
            topics.append(Topic(title, (), head, rows))
    failures = tuple(f"{each.name}: {each.failure}" for each in found if each.failure)
    if failures:
        topics.append(Topic("Could not be folded", failures))
    absent = tuple(f"{each.name}: {each.absent}" for each in found if each.absent)
    if absent:
        topics.append(Topic("Missing, an error with CI=true" if absent_fails else "Missing, skipped", absent))
    return topics


def guard_json(found: Sequence[GuardVerdict]) -> list[JsonObject]:
    """Return the verdicts for scripts, one object per recording; `change` is for the worse if positive."""
    return [
        {
            "recording": each.name,
            "version": each.version,
            "seconds": each.seconds,
            "failure": each.failure,
            "missing": each.absent,
            "figures": [
                {**one._asdict(), "verdict": "worse" if one.worse else "better" if one.better else "same"}
                for one in each.compared
            ],
        }
        for each in found
    ]


def junit(found: Sequence[GuardVerdict], *, absent_fails: bool) -> bytes:
    """Return the verdicts as JUnit XML: a suite per recording, a case per figure.

    A missing recording is an error if `absent_fails`, otherwise skipped.
    """
    root = ET.Element("testsuites", name="nisus guard")
    for each in found:
        suite = ET.SubElement(root, "testsuite", name=each.name, time=f"{each.seconds:.3f}")
        cases: list[tuple[str, str, str]] = [
            (figure.figure, "failure" if figure.worse else "", figure.in_words()) for figure in each.compared
        ]
        if each.failure or each.absent:
            kind = "error" if each.failure or absent_fails else "skipped"
            cases.insert(0, ("fold", kind, printable(each.failure or each.absent)))
        for name, kind, message in cases:
            case = ET.SubElement(suite, "testcase", classname=f"nisus.guard.{each.name}", name=name)
            if kind:
                ET.SubElement(case, kind, message=message)
        kinds = [kind for _, kind, _ in cases]
        counts = {"tests": len(cases), "failures": kinds.count("failure"), "errors": kinds.count("error")}
        for name, count in {**counts, "skipped": kinds.count("skipped")}.items():
            suite.set(name, str(count))
    for name in ("tests", "failures", "errors", "skipped"):
        root.set(name, str(sum(int(suite.get(name, "0")) for suite in root)))
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def keep_last(twin: Path, found: Sequence[GuardVerdict]) -> None:
    """Save verdicts beside the tuning versions of a twin; those of other recordings stay.

    A folder that cannot be written to is ignored: the verdict itself has been printed.
    """
    path = folders(twin)[0] / VERDICT_FILE
    saved = {each["recording"]: each for each in verdicts(twin)}
    for each in found:
        saved[each.name] = {
            "recording": each.name,
            "at": now(),
            "version": each.version,
            "figures": len(each.compared),
            "worse": [figure.in_words() for figure in each.compared if figure.worse],
            "better": [
                f"{one.figure} was {one.before:.6g} and is {one.now:.6g}" for one in each.compared if one.better
            ],
            "failure": each.failure,
        }
    text = json.dumps({"recordings": list(saved.values())}, indent=1)
    other = path.with_name(f".{VERDICT_FILE}.{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        other.write_text(text, encoding="utf-8")
        other.replace(path)
