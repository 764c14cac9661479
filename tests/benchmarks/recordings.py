"""`python -m tests.benchmarks.recordings`: real recordings, fitted on the first half, scored on the second.

Each is scored as shipped, as fitted (whether or not the fit was proposed), and by FilterPy with its own defaults, Q and
R the identity. The fit sees the first half alone, and its own judge of it blocks and sensors held out of that half. The
truth of the second half is known to nobody until it is scored. Where the band of a witness holds less than 90 or more
than 98 % of it there, that is told with how many independent errors say so, and how it was on the first half: a band
that held there, and one that a handful of errors leaves, are what no fit to the first half can know.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from app.twin.defaults import bounds_of
from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin, with_held
from estimators.diagnostics.references import references
from estimators.errors import NisusError
from estimators.fit.aims import AIMS, WITNESSES, correlation_time, track_of
from estimators.fit.entries import Setting
from estimators.fit.fit import fit
from estimators.fit.judge import PartScore, Z, worths
from estimators.fit.recording import Recording
from estimators.log import Log
from estimators.registry import find_entry, unfit

GOOD = (0.9, 0.98)  # Coverage that a band of 95 % should have of what was withheld


class Case(NamedTuple):
    """A twin, and how many seconds of its recording are taken; None for all."""

    twin: str
    seconds: float | None = None


CASES = (
    Case("uwb_rover_labyrinth"),
    Case("uwb_rover_plaza"),
    Case("battery_dmegc"),
    Case("motor_bench"),
    Case("motor_bench_joint"),
    Case("road_car_rav4"),
    Case("road_car", 600.0),
    Case("battery_panasonic", 2400.0),
)


def halves(log: Log) -> tuple[Log, np.ndarray]:
    """The first half in time, and a mask (n,) of the second."""
    middle = log.t[0] + (log.t[log.n - 1] - log.t[0]) // 2
    first = log.copy()
    first.n = int(np.searchsorted(log.events.t, middle))
    return first, log.events.t >= middle


def scored(twin: Twin, estimator: str, setting: Setting, log: Log, second: np.ndarray) -> PartScore:
    """What it is worth on the second half."""
    (worth,) = worths(estimator, [setting], [Recording(log, 1.0, second)], lambda folds: True)
    return worth.held_out


def outside(twin: Twin, setting: Setting, log: Log, second: np.ndarray) -> list[str]:
    """Of each witness whose band holds less or more than it should on the second half: how sure that is."""
    track = track_of(twin.estimator, setting, Recording(log, 1.0, second))
    found = []
    for item in references(twin.model, log.events, track):
        squares = (item.error / item.std) ** 2
        late = second[item.rows]
        if not late.any() or not (~late).any():
            continue
        then, now = (float(np.mean(squares[part] <= Z**2)) for part in (~late, late))
        if not GOOD[0] <= now <= GOOD[1]:
            independent = late.sum() / correlation_time(np.minimum(squares[late], 25.0 * squares[late].mean()))
            chance = np.sqrt(0.95 * 0.05 / independent)
            said = f"{100 * now:.1f} % of {late.sum():,}, about {independent:.0f} independent errors"
            said += f", by chance 95 ± {100 * chance:.0f} %; {100 * then:.0f} % on the first half"
            found.append(f"{item.name} {said}")
    return found


def line(name: str, part: PartScore) -> str:
    """As a row of the table."""

    def predictions(group: str) -> str:
        items = getattr(part, group).items()
        return ", ".join(f"{key} {item.rms:.3g} {item.unit} {100 * item.coverage:.0f} %" for key, item in items) or "-"

    return (
        f"  {name:12} NIS/dof {part.nis:8.3g}  in band {100 * part.coverage:5.1f} %  "
        f"log density {part.log_density:8.3g}\n"
        f"      sensors held out in turn: {predictions('sensors')}\n"
        f"      sensors never used: {predictions('withheld')}\n      truth: {predictions('states')}"
    )


def show(case: Case, wanted: Sequence[str], aim: str) -> None:
    """Fit and print one recording."""
    twin = with_held(load_twin(case.twin))
    log, _ = read_log(twin, case.seconds)
    first, second = halves(log)
    own = Setting(twin.tuning, None)
    print(f"{case.twin}, {twin.estimator}: {first.n:,} events fitted, {int(second.sum()):,} scored", flush=True)
    print(line("as shipped", scored(twin, twin.estimator, own, log, second)), flush=True)
    bounds = bounds_of(twin.config, twin.model)
    found = fit(twin.estimator, twin.tuning, [Recording(first)], wanted=wanted, bounds=bounds, aim=aim)
    for item in found.lines:
        what = (
            "left alone" if item.alone else f"{item.before:.3g} -> {item.after:.3g} ({item.low:.2g} to {item.high:.2g})"
        )
        print(f"      {item.key} {what}")
    gained = f"{found.verdict.gain:+.3g} ± {found.verdict.error:.2g}"
    print(f"      power {found.power:.3g}, {found.folds} folds, gain on the blocks held out {gained}")
    print("      " + ("proposed" if found.proposed else "not proposed: " + "; ".join(found.verdict.reasons)))
    print(line("fitted", scored(twin, twin.estimator, found.setting, log, second)), flush=True)
    accepted = found.setting if found.proposed else own
    for text in outside(twin, accepted, log, second):
        print(f"      outside 90 to 98 %, as accepted: {text}")
    theirs = "filterpy-ekf"
    if unfit(find_entry(theirs), twin.model) is None:
        unit = replace(
            twin.tuning.with_options({}), q=np.ones_like(twin.tuning.q), r=np.ones_like(twin.tuning.r), gate=None
        )
        try:
            print(line("FilterPy", scored(twin, theirs, Setting(unit, None), log, second)), flush=True)
        except NisusError as error:
            print(f"  FilterPy: {error}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twins", nargs="*", help="only these")
    parser.add_argument("--fit", default="Q,R")
    parser.add_argument("--aim", default=WITNESSES, choices=AIMS)
    arguments = parser.parse_args()
    for case in CASES:
        if not arguments.twins or case.twin in arguments.twins:
            show(case, arguments.fit.split(","), arguments.aim)


if __name__ == "__main__":
    main()
