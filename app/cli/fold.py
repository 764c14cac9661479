"""`nisus fold`: a twin's readings folded as fast as possible, and what the estimate was worth."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq

from estimators.diagnostics.episodes import Episode, as_dict, episodes
from estimators.diagnostics.failure_cause import failures
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.score import Score, score
from estimators.errors import ConfigError, SourceError
from estimators.fold import Fold
from estimators.interface.table import table_of
from estimators.log import Log
from estimators.track import FAILED, HEALTH_NAMES, USED, Track
from estimators.tuning import TOGETHER
from sources.source import Endless

from ..engine.stall import interruptible
from ..twin.twin import Twin, load_twin
from .arguments import settings
from .fold_episodes import episode_lines
from .prepare import prepare
from .remarks import remarking

if TYPE_CHECKING:
    from .arguments import Fold as Arguments


def read_log(twin: Twin, duration: float | None) -> tuple[Log, Counter[str]]:
    """Everything that the twin's source says, in the order of time, and what was counted on the way.

    Raises:
        SourceError: If the source cannot be opened, has no end, or says nothing.
    """
    counts: Counter[str] = Counter()

    def count(key: str, text: str) -> None:
        counts[key] += 1

    source = twin.open_source(remarking(count), live=False)
    if duration is None and isinstance(source, Endless) and source.endless:
        source.close()
        raise SourceError(f"{twin.name}: its source has no end; give --duration SECONDS")
    log = Log.of(twin.model)
    horizon = round(twin.config.time.horizon * 1e9)
    try:
        while (batch := source.read(1.0)) is not None:
            _, stale = log.extend(batch, horizon)
            counts["stale"] += stale
            if duration is not None and log.n and log.t[log.n - 1] - log.t[0] > duration * 1e9:
                log.n = int(np.searchsorted(log.t[: log.n], log.t[0] + round(duration * 1e9), side="right"))
                break
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
        arguments.twin, log_files=arguments.log or None, overrides=settings(arguments.set, arguments.estimator)
    )
    if arguments.out is not None and arguments.out.suffix not in (".parquet", ".rrd"):
        raise ConfigError(f"--out {arguments.out}: must end in .parquet or .rrd")
    prepare(twin)
    log, counts = read_log(twin, arguments.duration)
    period = twin.picture if arguments.out is not None and arguments.out.suffix == ".rrd" else None
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, pairs=twin.pairs, policy=twin.policy, picture=period)
    begun = time.perf_counter()

    def work() -> None:
        fold.advance()
        fold.finish()

    interruptible(fold, work)
    seconds = (time.perf_counter() - begun) / log.n
    pictures = fold.pictures.taken if fold.pictures is not None else []
    result = score(fold.track, log.events, twin.model, pictures)
    if arguments.out is not None:
        _write(arguments.out, twin, log, fold.track, pictures, episodes(fold))
    if arguments.json:
        print(json.dumps(_as_dict(twin, result, seconds, counts, fold)))
    else:
        _print(twin, result, seconds, counts, fold)
    return 0


def _decimals(number: float) -> str:
    """A number with four decimals, or four digits where that is more than a line can hold."""
    return f"{number:.4f}" if abs(number) < 1e6 else f"{number:.4g}"


def _as_dict(twin: Twin, result: Score, seconds: float, counts: Counter[str], fold: Fold) -> dict[str, Any]:
    """What a script needs of a fold.

    `rmse` and `coverage` (the share of errors inside their 95 % band) are by state and `held_out` by sensor row, in
    their units; `stale` counts the readings that came too late to be among the `readings`, `conditioned` those that a
    condition of the source's map refused; `health` is the share of the track's rows in each state of health;
    `episodes` have start and end in seconds of the log (end null while one lasts).
    """

    def number(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "twin": twin.name,
        "estimator": twin.estimator,
        "readings": result.readings,
        **({"field": {"rmse": result.field.rmse, "coverage": result.field.coverage}} if result.field else {}),
        "rmse": {name: number(fit.rmse) for name, fit in result.states.items()},
        "coverage": {name: number(fit.coverage) for name, fit in result.states.items()},
        "held_out": {
            name: {"rmse": number(fit.rmse), "bias": number(fit.bias), "coverage": number(fit.coverage)}
            for name, fit in result.held_out.items()
        },
        "nis": {
            "mean": number(result.nis),
            "low": number(result.nis_low),
            "high": number(result.nis_high),
            "n": result.nis_readings,
        },
        "log_likelihood": number(result.log_likelihood),
        "used": int(np.sum(fold.track.verdict == USED)),
        "stale": counts["stale"],
        "conditioned": sum(count for key, count in counts.items() if key.startswith("condition ")),
        "gated": result.gated,
        "missing": result.missing,
        "failed": int(np.sum(fold.track.verdict == FAILED)),
        "failure": _why(fold),
        "health": {
            name: float(share)
            for name, share in zip(
                HEALTH_NAMES, np.bincount(fold.track.health, minlength=len(HEALTH_NAMES)) / len(fold.track), strict=True
            )
        },
        "episodes": [as_dict(episode) for episode in episodes(fold)],
        "seconds_per_event": seconds,
    }


def _why(fold: Fold) -> str | None:
    """What of the model made the first reading or estimate fail that did."""
    rows = failures(fold.track)
    return fold.cause(int(rows[0])) if rows.size else None


def _print(twin: Twin, result: Score, seconds: float, counts: Counter[str], fold: Fold) -> None:
    track = fold.track
    units = {state.name: state.unit for state in twin.model.shown_states}
    grid = twin.model.grid
    rows = [
        ("twin", f"{twin.name}: {twin.title}"),
        ("estimator", twin.estimator),
        ("readings", f"{result.readings}"),
    ]
    model = twin.model
    if result.field is not None and grid is not None:
        fit = result.field
        inside = f"in the 95 % band: {100 * fit.coverage:.1f} %"
        rows.append((f"RMSE {grid.name}, all cells whose truth is known", f"{fit.rmse:.5g} {grid.unit}   {inside}"))
    rows += [
        (model.label(name), f"{track.mean[-1, k]:.3f} at the end   Brier score (mean square error): {fit.rmse**2:.5g}")
        if model.mode >= 0 and name == model.state_names[model.mode]
        else (f"RMSE {name}", f"{fit.rmse:.5g} {units[name]}   in the 95 % band: {100 * fit.coverage:.1f} %")
        for k, (name, fit) in enumerate(result.states.items())
    ]
    if result.nis_readings:
        inside = "inside" if result.nis_low <= result.nis <= result.nis_high else "OUTSIDE"
        bounds = f"{result.nis_low:.4f} to {result.nis_high:.4f} of {result.nis_readings} readings"
        rows.append(("mean NIS", f"{_decimals(result.nis)}   {inside} its 95 % bounds {bounds}"))
    # The many rows of one sensor are one line.
    together = {}
    for sensor, start in zip(twin.model.sensors, twin.model.row_start, strict=True):
        names = [name for name in twin.model.row_names[start : start + len(sensor.rows)] if name in result.held_out]
        if len(names) >= TOGETHER and len({row.unit for row in sensor.rows}) == 1:
            together[sensor.name] = names
    many = {name for names in together.values() for name in names}
    rows += [
        ("log-likelihood", f"{result.log_likelihood:.2f}"),
        ("gated", f"{result.gated}"),
        ("missing", f"{result.missing}"),
    ]
    failed = int(np.sum(track.verdict == FAILED))
    if failed:
        rows.append(("failed", f"{failed}: no estimate, or none with this reading, is a number"))
    why = _why(fold)
    if why:
        rows.append((f"the model failed {fold.failures} time(s)" if fold.failures else "because", why))
    row_units = dict(
        zip(twin.model.row_names, [row.unit for sensor in twin.model.sensors for row in sensor.rows], strict=True)
    )
    rows += [
        (f"held out {name}", f"RMSE {fit.rmse:.5g} {row_units[name]}   in the 95 % band: {100 * fit.coverage:.1f} %")
        for name, fit in result.held_out.items()
        if name not in many
    ]
    for sensor_name, own in together.items():
        fits = [result.held_out[name] for name in own]
        rmse = float(np.sqrt(np.mean([fit.rmse**2 for fit in fits])))
        share = 100 * float(np.mean([fit.coverage for fit in fits]))
        text = f"RMSE {rmse:.5g} {row_units[own[0]]}   in the 95 % band: {share:.1f} %"
        rows.append((f"held out {sensor_name}, {len(own)} rows", text))
    rows += [(key, f"{count}") for key, count in sorted(counts.items())]
    variances = ", ".join(
        f"{twin.model.state_names[j]} {value**2:.5g}" for j, value in zip(twin.model.shown, track.std[-1], strict=True)
    )
    rows += [
        ("final variances", variances),
        ("health at the end", HEALTH_NAMES[int(track.health[-1])]),
        ("time per event", f"{1e6 * seconds:.2f} µs"),
    ]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:<{width}}  {value}")
    for line in episode_lines(episodes(fold)):
        print(line)


def _write(
    path: Path, twin: Twin, log: Log, track: Track, pictures: Sequence[Picture], found: Sequence[Episode]
) -> None:
    if path.suffix == ".rrd":
        from ..recording.writer import write_recording

        write_recording(path, twin, log, track, pictures, found)
        return
    pq.write_table(table_of(twin.model, log.events, track, found), path)
