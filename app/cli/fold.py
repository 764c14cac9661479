"""`nisus fold`: fold the log of a twin as fast as possible and score the estimate."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from config.extensions import left_out, maker, registered
from config.yaml_files import writing
from estimators.diagnostics.episodes import Episode
from estimators.errors import ConfigError
from estimators.registry import find_estimator
from estimators.smoothing.walk import Smoothed

from ..record.rrd_file import TAKEN
from ..render.text import to_text
from ..result import to_json
from ..study.fold_result import FoldResult, fold_json, fold_topics, known_states, pairs_with, rows_of, with_covariance
from ..study.scores import pictures_of
from ..twin.log_reader import read_log
from .arguments import FoldCommand as Arguments
from .options import span_of
from .prepare import attend, fold_log, opened, prepare


def fold_twin(arguments: Arguments) -> int:
    """Fold the log of a twin, and print or write the result."""
    twin = opened(arguments)
    out = arguments.out
    write: Callable[..., None] | None = None
    if out is not None:
        others = registered("tracks")
        if out.suffix in others:
            write = maker("tracks", out.suffix)(out)
        elif out.suffix not in (".csv", ".parquet", ".rrd"):
            endings = ", ".join((".csv", ".parquet", *others))
            raise ConfigError(f"--out {out}: must end in {endings} or .rrd{left_out()}")
    recorded = out is not None and out.suffix == ".rrd"
    if out is not None and recorded and os.path.lexists(out):
        raise ConfigError(f"--out {out}: {TAKEN}")
    if arguments.plot is not None:
        plot_track = maker("pictures", "track", "--plot", "plot")(arguments.plot)
    if arguments.smooth:
        from estimators.smoothing.smooth import check_smooth, smooth

        check_smooth(find_estimator(twin.estimator, twin.model), twin.model, twin.tuning.options)
    prepare(twin)
    log, counts = read_log(twin, arguments.duration, blind=arguments.blind)
    known = known_states(twin, log.events)
    kept = with_covariance(twin, log.events, twin.model.shown) if write else []
    begun = time.perf_counter()
    fold = fold_log(twin, log, picture=twin.picture if recorded else None, pairs=pairs_with(twin, kept or known))
    seconds = (time.perf_counter() - begun) / log.n
    part = rows_of(log, span_of(arguments, log.events))
    smoothed: Smoothed | None = attend(twin.model, lambda: smooth(fold), "smoothing") if arguments.smooth else None
    result = FoldResult(twin, fold, counts, seconds, part, known, smoothed)
    events, track, found = result.events, result.track, [item.episode for item in result.episodes]
    if out is not None:
        _write(out, result, found, write)
    if arguments.html is not None:
        from ..render.html import to_html
        from ..render.report import Reported, report

        run = Reported(
            twin, twin.estimator, twin.tuning, events, track, pictures_of(fold, part), found, fold.marginal,
            smoothed=smoothed and smoothed.select(part),
        )  # fmt: skip
        with writing(arguments.html, "--html"):
            arguments.html.write_text(to_html(f"{twin.name}, {twin.estimator}", report(run)), encoding="utf-8")
    if arguments.plot is not None:
        with writing(arguments.plot, "--plot"):
            title = f"{twin.name}, {twin.estimator}"
            figure = plot_track(twin.model, events, track, episodes=found, title=title)
            figure.savefig(arguments.plot, dpi=150)
    print(to_json(fold_json(result)) if arguments.json else to_text(fold_topics(result)))
    return 0


def _write(path: Path, result: FoldResult, found: list[Episode], write: Callable[..., None] | None) -> None:
    """Write the track with the episodes `found` as a recording, a table, or as an extension does."""
    twin, fold, smoothed = result.twin, result.fold, result.smoothed
    if path.suffix == ".rrd":
        from ..record.writer import write_recording

        write_recording(path, twin, fold.log, fold.track, pictures_of(fold), found, smoothed)
        return
    if write is not None:
        with writing(path, "--out"), path.open("wb") as file:
            write(file, twin, fold, smoothed)
        return
    from estimators.interface.table import table_of

    from ..render.track_file import encoded

    table = table_of(
        twin.model, fold.log.events, fold.track, found, smoothed=smoothed,
        tuning_version=twin.tuning.version, tuning=twin.tuning.name, model_version=fold.log.version,
    )  # fmt: skip
    with writing(path, "--out"), path.open("wb") as file:
        file.writelines(encoded(path.suffix[1:], [table]))
