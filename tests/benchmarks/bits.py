"""The bits of every filter on every twin: a hash of each track, to compare before and after a change.

    python -m tests.benchmarks.bits --write before.json      on one checkout
    python -m tests.benchmarks.bits --against before.json    on another, on the same processor

A refactoring must leave every hash as it is; a fix must change only those that it explains.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin
from config.loader import shipped
from estimators.errors import NisusError
from estimators.fold import Fold
from estimators.log import Log
from estimators.registry import ESTIMATORS, unfit
from tests.support import folded

EVENTS = 400
"""Events of a log that are folded; of a filter or model that is slow, as many as `SECONDS` allow, but `LEAST`."""

LEAST = 24

WHOLE = frozenset({"gripper_contact/ukf"})
"""Twins and filters of which all events are folded: the gate closes late, and a second story opens it again."""


def digest(fold: Fold) -> str:
    """One hash of all columns of a track but the health, which is a judgement of it, and of the filter's state."""
    track = fold.track
    total = hashlib.sha256()
    for name in ("mean", "std", "cross", "innovation", "innovation_std", "nis", "dof", "log_likelihood", "verdict"):
        column = np.ascontiguousarray(getattr(track, name))
        # One NaN has many bit patterns; which one a processor leaves is no part of the result.
        if column.dtype.kind == "f":
            column = np.where(np.isnan(column), np.nan, column)
        total.update(column.tobytes())
    return total.hexdigest()[:16]


def events_of(twin: Twin, name: str) -> int:
    """How many events a filter folds: fewer where a state is large or a filter is interpreted."""
    entry = ESTIMATORS[name]
    numbers = entry.state_size(entry.complete(dict(twin.options_of(name))), twin.model.nx)
    return LEAST if numbers > 200_000 or twin.model.nx > 1024 else EVENTS


def read_whole(twin: Twin) -> Log:
    """The log of a twin; a minute of one that has no end."""
    try:
        return read_log(twin, None)[0]
    except NisusError:
        return read_log(twin, 60.0)[0]


def hashes(names: list[str]) -> dict[str, str]:
    """`twin/filter` to hash, or to the reason why there is none."""
    found: dict[str, str] = {}
    for twin_name in names:
        try:
            twin = load_twin(twin_name)
            whole = read_whole(twin)
        except NisusError as error:
            found[twin_name] = f"not read: {type(error).__name__}"
            continue
        for name, entry in ESTIMATORS.items():
            if unfit(entry, twin.model):
                continue
            begun = time.perf_counter()
            key = f"{twin_name}/{name}"
            most = whole.n if key in WHOLE else events_of(twin, name)
            events = whole.events.select(slice(0, most))
            log = Log(twin.model.width, len(events))
            log.extend(events)
            tuning = replace(twin.tuning, options=twin.options_of(name))
            try:
                fold = folded(name, twin.model, log, tuning, pairs=twin.pairs)
                found[key] = digest(fold)
            except NisusError as error:
                found[key] = f"not folded: {error}"
            print(f"{key:45} {found[key]}  {log.n} events, {time.perf_counter() - begun:.1f} s", file=sys.stderr)
    return found


def main() -> int:
    """Carry the command out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twins", nargs="*", help="names of twins; all that ship, if none is given")
    parser.add_argument("--write", type=Path, help="file to write the hashes to")
    parser.add_argument("--against", type=Path, help="file of hashes to compare with")
    given = parser.parse_args()
    found = hashes(given.twins or shipped())
    if given.write:
        given.write.write_text(json.dumps(found, indent=1) + "\n")
    if given.against:
        before = json.loads(given.against.read_text())
        changed = [key for key in sorted(found) if found[key] != before.get(key)]
        for key in changed:
            print(f"{key}: {before.get(key, 'not there')} before, {found[key]} now")
        print(f"{len(found) - len(changed)} of {len(found)} the same")
        return bool(changed)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
