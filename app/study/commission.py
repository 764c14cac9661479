"""Baseline of an accepted tuning: the statistics of its innovations on a trusted log, and the checks before."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from config.old_names import read_yaml
from config.yaml_files import TWINS, baseline_file, read_text, shown_path, writing
from estimators.diagnostics.episodes.baseline import Normal, commission, contradictions
from estimators.diagnostics.score import score
from estimators.errors import ConfigError
from estimators.fold import Fold
from estimators.track import DIVERGED, FAILED, GATED, SCREENED, STALE

from ..twin.twin import Twin
from ..twin.versions import write_section

MAX_FAULTY_SHARE = 0.1
"""Share of readings refused, of rows lost, or of one value in a row, beyond which data are not in order."""

MIN_COVERAGE = 0.6
"""Share of the true values in the 95 % band below which an estimate is not in order: errors are 2.3 times σ there."""

MAX_EQUAL_RUN = 50  # equal readings in a row that are never too many


def store_baseline(twin: Twin, section: str) -> Path:
    """Write the section of a baseline; return its file.

    It is that of the twin's tuning version, the twin's own if that has the section, else NAME.baseline.yaml beside it.

    Raises:
        ConfigError: If it cannot be written.
    """
    path = baseline_file(twin.path)
    if twin.version is not None:
        path = twin.version.path
    elif "baseline" in read_yaml(read_text(twin.path, "nisus twins"), shown_path(twin.path))[1]:
        path = twin.path
    if path.is_file():
        write_section(path, "baseline", section)
    else:
        with writing(path):
            path.write_text(section, encoding="utf-8")
    return path


def storable(twin: Twin) -> bool:
    """Return whether the page may store a baseline: the twin is a file of the user's own, not a recording."""
    path = twin.path if twin.version is None else twin.version.path
    own = path.suffix in (".yaml", ".yml") and path.is_file() and TWINS not in path.absolute().parents
    return own and not twin.recorded


def baseline_of(fold: Fold, name: str, *, force: bool, option: str = "--force") -> dict[str, Normal]:
    """Return the baseline by sensor row; with `force` also that of a fold that cannot be normal, marked as such.

    `option` is the name of `force` for users.

    Raises:
        ConfigError: If the fold cannot be normal.
    """
    broken = against(fold)
    if broken and not force:
        raise ConfigError(
            f"{name}: {broken}; commission on a log without the fault, fit the tuning (nisus tune), or accept it "
            f"with {option}, which marks the baseline"
        )
    return {name: normal._replace(forced=broken) for name, normal in commission(fold).items()}


def against(fold: Fold) -> str:
    """Why a fold cannot be what is normal, in one line; nothing if it can."""
    model, log, track = fold.model, fold.log, fold.track
    lost = float(np.mean((track.health == DIVERGED) | (track.health == STALE)))
    if lost > MAX_FAULTY_SHARE:
        return f"the twin is diverged or stale for {100 * lost:.0f} % of its rows"
    for s, sensor in enumerate(model.sensors):
        rows = fold.events.of_sensor(s)
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
    scored = score(track, fold.events, model)
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
    text = "baseline:                        # what was normal when this tuning was accepted (nisus commission)\n"
    for name, normal in normals.items():
        reached = ", ".join(f"{cause}: {peak:g}" for cause, peak in normal.reached.items())
        nis = f", nis: {normal.nis:g}" if normal.nis else ""
        forced = f", forced: {json.dumps(normal.forced, ensure_ascii=False)}" if normal.forced else ""
        moments = f"bias: {normal.bias:g}, scale: {normal.scale:g}, correlation: {normal.correlation:g}{nis}{forced}"
        text += f"  {name}: {{{moments},\n"
        text += f"    reached: {{{reached}}}}}\n"
    return text
