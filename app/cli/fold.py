"""`nisus fold`: a twin's readings folded as fast as possible, and what the estimate was worth."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from config.files import writing
from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.score import score
from estimators.errors import ConfigError
from estimators.fold import Fold
from estimators.interface.table import table_of
from estimators.log import Log
from estimators.registry import find_estimator
from estimators.smoothing.smooth import check_smooth, smooth
from estimators.smoothing.smoothed import Smoothed
from estimators.track import Track

from ..live.watchdog import interruptible
from ..present.export.report import Reported, report
from ..present.export.track_file import encoded
from ..present.result import to_html
from ..studies.fold_result import Better, as_dict, as_text, blamed, calibration_of, dropped, episode_lines
from ..twin.log_reader import read_log
from ..twin.twin import Twin, load_twin
from ..views.recording.format import TAKEN
from .options import settings
from .prepare import attend, prepare

if TYPE_CHECKING:
    from .arguments import Fold as Arguments


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
        with writing(arguments.html, "--html"):
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
    with writing(path, "--out"), path.open("wb") as file:
        file.writelines(encoded(path.suffix[1:], [table]))
