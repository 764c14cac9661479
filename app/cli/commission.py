"""`nisus commission`: store the baseline of an accepted tuning in the YAML of the twin."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from estimators.diagnostics.episodes import episodes
from estimators.diagnostics.episodes.baseline import Normal, commission, contradictions
from estimators.diagnostics.score import score
from estimators.errors import ConfigError
from estimators.fold import Fold
from estimators.log import READING
from estimators.track import DIVERGED, FAILED, GATED, HEALTH_NAMES, SCREENED, STALE

from ..format_time import duration_text
from ..live.tunings.versions import write_section
from ..live.watchdog import interruptible
from ..present.result import to_json
from ..terminal import complain
from ..twin.log_reader import read_log
from ..twin.twin import load_twin
from .options import settings
from .prepare import prepare

if TYPE_CHECKING:
    from .arguments import CommissionCommand as Arguments

MAX_FAULTY_SHARE = 0.1
"""Share of readings refused, of rows lost, or of one value in a row, beyond which data are not in order."""

MIN_COVERAGE = 0.6
"""Share of the true values in the 95 % band below which an estimate is not in order: errors are 2.3 times σ there."""

MAX_EQUAL_RUN = 50  # equal readings in a row that are never too many


def commission_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    # What is normal is told from white innovations, not from what was normal before.
    overrides = {**settings(arguments.set, arguments.estimator, arguments.tuning), "commissioned": "{}"}
    twin = load_twin(arguments.twin, log_files=arguments.log or None, overrides=overrides)
    prepare(twin)
    log, _ = read_log(twin, arguments.duration)
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, policy=twin.policy)
    interruptible(fold, fold.advance)
    gaps = [item.size for item in episodes(fold) if item.cause == HEALTH_NAMES[STALE]]
    if gaps:
        complain(
            f"{twin.name}: {len(gaps)} gap(s) without measurements, the longest {duration_text(max(gaps))}; the "
            "estimate is stale there, and they take no part in the baseline"
        )
    broken = against(fold)
    if broken and not arguments.force:
        raise ConfigError(
            f"{twin.name}: {broken}; commission on a log without the fault, fit the tuning (nisus tune), or accept it "
            "with --force, which marks the baseline"
        )
    normals = {name: normal._replace(forced=broken) for name, normal in commission(fold).items()}
    text = lines(normals)
    path = twin.path if twin.version is None else twin.version.path
    if arguments.write:
        write_section(path, "commissioned", text)
    if arguments.json:
        written = str(path) if arguments.write else None
        head = {"twin": twin.name, "estimator": twin.estimator, "events": log.n, "written": written}
        print(to_json({**head, "commissioned": normals}))
    elif arguments.write:
        print(f"{path}: commissioned on {log.n} events of {twin.name}, {twin.estimator}")
    else:
        print(text, end="")
    return 0


def against(fold: Fold) -> str:
    """Why a fold cannot be what is normal, in one line; nothing if it can."""
    model, log, track = fold.model, fold.log, fold.track
    lost = float(np.mean((track.health == DIVERGED) | (track.health == STALE)))
    if lost > MAX_FAULTY_SHARE:
        return f"the twin is diverged or stale for {100 * lost:.0f} % of its rows"
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero((log.kind[: fold.n] == READING) & (log.channel[: fold.n] == s))
        if not rows.size:
            continue
        refused = float(np.mean(np.isin(track.verdict[rows], (GATED, FAILED, SCREENED))))
        if refused > MAX_FAULTY_SHARE:
            return f"{100 * refused:.0f} % of the readings of {sensor.name} are refused"
        for k, row in enumerate(sensor.rows):
            value = log.value[rows, k]
            changes = np.flatnonzero(np.diff(value, prepend=np.nan, append=np.nan) != 0.0)
            longest = int(np.max(np.diff(changes))) if changes.size > 1 else 0
            if longest > max(MAX_EQUAL_RUN, MAX_FAULTY_SHARE * rows.size):
                return f"{row.name} of {sensor.name} says the same {longest} times in a row"
    for row_name, why in contradictions(fold).items():
        return f"{row_name} contradicts its own log, {why}"
    scored = score(track, log.events.select(slice(0, fold.n)), model)
    for state, fit in scored.states.items():
        if fit.coverage < MIN_COVERAGE:
            return f"the true {state} is in its 95 % band only {100 * fit.coverage:.0f} % of the time"
    return ""


def lines(normals: Mapping[str, Normal]) -> str:
    """The section of the YAML.

    Raises:
        ConfigError: If no row has enough readings.
    """
    if not normals:
        raise ConfigError("no sensor row has 50 readings that were judged; commission on a longer recording")
    text = "commissioned:                    # what was normal when this tuning was accepted (nisus commission)\n"
    for name, normal in normals.items():
        reached = ", ".join(f"{cause}: {peak:g}" for cause, peak in normal.reached.items())
        nis = f", nis: {normal.nis:g}" if normal.nis else ""
        forced = f", forced: {json.dumps(normal.forced, ensure_ascii=False)}" if normal.forced else ""
        moments = f"bias: {normal.bias:g}, scale: {normal.scale:g}, correlation: {normal.correlation:g}{nis}{forced}"
        text += f"  {name}: {{{moments},\n"
        text += f"    reached: {{{reached}}}}}\n"
    return text
