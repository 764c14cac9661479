"""`nisus fold`: a twin's readings folded as fast as possible, and what the estimate was worth."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.score import score
from estimators.errors import ConfigError, SourceError
from estimators.fold import Fold
from estimators.interface.table import table_of
from estimators.late import inflated
from estimators.log import Log
from estimators.registry import find_estimator
from estimators.smoothing.smooth import check_smooth, smooth
from estimators.smoothing.smoothed import Smoothed
from estimators.track import Track
from sources.source import Endless

from ..intake import Intake
from ..live.watchdog import interruptible
from ..present.export.report import Reported, report
from ..present.export.track_file import encoded
from ..present.result import to_html
from ..twin.twin import Twin, load_twin
from ..views.recording.format import TAKEN
from .fold_episodes import blamed, dropped, episode_lines
from .fold_report import as_dict, as_text, calibration_of
from .fold_smoothed import Better
from .given import settings
from .prepare import attend, prepare
from .remarks import remarking

if TYPE_CHECKING:
    from estimators.events.clocks import Passed

    from .arguments import Fold as Arguments


def read_log(twin: Twin, duration: float | None) -> tuple[Log, Counter[str]]:
    """Everything that the twin's source says, in the order of time, and what was counted on the way.

    Raises:
        ConfigError: If `duration` is not positive.
        SourceError: If the source cannot be opened, has no end, or says nothing.
    """
    if duration is not None and not duration > 0.0:
        raise ConfigError(f"--duration {duration:g}: must be positive")
    counts: Counter[str] = Counter()

    def count(key: str, text: str) -> None:
        counts[key] += 1

    def put(passed: Passed) -> None:
        events = passed.events
        if beside is not None:
            events, late = inflated(events, beside, log.newest, horizon)
            counts["inflated"] += late
        first, stale = log.extend(events, horizon, passed.settled)
        counts["stale"] += stale
        if beside is not None:
            beside.rewind(first)
            beside.advance()

    remark = remarking(count)
    source = twin.open_source(remark, live=False)
    if duration is None and isinstance(source, Endless) and source.endless:
        source.close()
        raise SourceError(f"{twin.name}: its source has no end; give --duration SECONDS")
    log = Log.of(twin.model)
    horizon = round(twin.config.time.horizon * 1e9)
    # What a late reading is inflated by is asked of the estimate when it comes.
    beside = Fold(twin.estimator, twin.model, twin.tuning, log) if twin.late.inflate else None
    intake = Intake(twin.model, horizon, remark, twin.maintenance)
    try:
        while (batch := source.read(1.0)) is not None:
            put(intake.take(batch))
            if duration is not None and log.n and log.t[log.n - 1] - log.t[0] > duration * 1e9:
                log.n = int(np.searchsorted(log.t[: log.n], log.t[0] + round(duration * 1e9), side="right"))
                break
        else:
            put(intake.finish())
    finally:
        source.close()
    if not log.n:
        files = ", ".join(map(str, twin.plan.log_files or ()))
        place = f"--log {files}" if files else twin.loaded.places.at(("source",))
        raise SourceError(f"{place}: the source said nothing that a sensor needs; check the channel maps")
    return log, +counts


def fold_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    twin = load_twin(
        arguments.twin,
        log_files=arguments.log or None,
        overrides=settings(arguments.set, arguments.estimator, arguments.tuning),
    )
    if arguments.out is not None and arguments.out.suffix not in (".csv", ".parquet", ".rrd"):
        raise ConfigError(f"--out {arguments.out}: must end in .csv, .parquet or .rrd")
    if arguments.out is not None and arguments.out.suffix == ".rrd" and os.path.lexists(arguments.out):
        raise ConfigError(f"--out {arguments.out}: {TAKEN}")
    if arguments.smooth:
        check_smooth(find_estimator(twin.estimator, twin.model), twin.model, twin.tuning.options)
    prepare(twin)
    log, counts = read_log(twin, arguments.duration)
    period = twin.picture if arguments.out is not None and arguments.out.suffix == ".rrd" else None
    fold = Fold(
        twin.estimator,
        twin.model,
        twin.tuning,
        log,
        pairs=twin.pairs,
        policy=twin.policy,
        picture=period,
        expected=twin.expected,
    )
    begun = time.perf_counter()

    def work() -> None:
        fold.advance()
        fold.finish()

    interruptible(fold, work)
    seconds = (time.perf_counter() - begun) / log.n
    pictures = fold.pictures.taken if fold.pictures is not None else []
    result = score(fold.track, log.events, twin.model, pictures, gate=twin.tuning.gate, baseline=twin.tuning.baseline)
    smoothed = attend(twin.model, lambda: smooth(fold), "smoothing") if arguments.smooth else None
    better = Better.of(fold, smoothed) if smoothed is not None else None
    found = calibration_of(twin, fold)
    told = blamed(fold, [*dropped(counts, fold), *episodes(fold)])
    if arguments.out is not None:
        _write(arguments.out, twin, log, fold.track, pictures, [item.episode for item in told], smoothed)
    if arguments.html is not None:
        run = Reported(
            twin, twin.estimator, twin.tuning, log.events, fold.track, pictures, [item.episode for item in told],
            fold.marginal, smoothed=smoothed,
        )  # fmt: skip
        arguments.html.write_text(to_html(f"{twin.name}, {twin.estimator}", report(run)), encoding="utf-8")
    if arguments.json:
        print(json.dumps(as_dict(twin, result, found, seconds, counts, fold, told, better)))
    else:
        print("\n".join([*as_text(twin, result, found, seconds, counts, fold, better), *episode_lines(told)]))
    return 0


def _write(
    path: Path,
    twin: Twin,
    log: Log,
    track: Track,
    pictures: Sequence[Picture],
    found: Sequence[Episode],
    smoothed: Smoothed | None,
) -> None:
    if path.suffix == ".rrd":
        from ..views.recording.writer import write_recording

        write_recording(path, twin, log, track, pictures, found, smoothed)
        return
    table = table_of(
        twin.model, log.events, track, found, smoothed=smoothed,
        tuning_version=twin.tuning.version, tuning=twin.tuning.name, model_version=log.version,
    )  # fmt: skip
    with path.open("wb") as file:
        file.writelines(encoded(path.suffix[1:], [table]))
