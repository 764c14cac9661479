"""Row counts and latency for the status, and notices about rejected measurements."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from estimators.log import READING, Events, Log
from estimators.model.sensor import Limits, Pair
from estimators.model.state_space import StateSpaceModel
from estimators.plausibility import reasons_by_sensor
from estimators.track import FAILED, GATED, MISSING, REASONS, SCREENED, VERDICT_NAMES, Track

UNSETTLED = 8192
"""Last rows, which are counted each time; a late measurement rarely reaches back further."""

LATENCIES = 4096


class RowCounts:
    """Rows of each sensor by verdict and by reason of the plausibility checks, since the start.

    Settled rows are counted once.
    """

    def __init__(self, model: StateSpaceModel) -> None:
        self._sensors = model.sensor_names
        self._forgotten = np.zeros((len(self._sensors), len(VERDICT_NAMES) + len(REASONS)), np.int64)
        self.again()

    def again(self) -> None:
        """Count all rows again, on top of the dropped ones."""
        self._settled, self._counts = 0, self._forgotten.copy()

    def changed(self, index: int) -> None:
        """Note that the rows from `index` on changed."""
        if index < self._settled:
            self.again()

    def forget(self, track: Track, channel: np.ndarray) -> None:
        """Drop the oldest rows, with these channels."""
        self._forgotten = self._forgotten + self._of(track, channel, slice(0, len(track)))
        self.again()

    def count(self, track: Track, channel: np.ndarray) -> dict[str, int]:
        """Return counts in total, by verdict, and by sensor and reason, given all rows and their channels."""
        settled = max(self._settled, len(track) - UNSETTLED)
        self._counts += self._of(track, channel, slice(self._settled, settled))
        self._settled = settled
        table = self._counts + self._of(track, channel, slice(settled, len(track)))
        each, reasons = np.split(table, [len(VERDICT_NAMES)], axis=1)
        totals = each.sum(axis=0)
        counts = {"readings": int(totals[1:].sum())}
        counts |= {name: int(count) for name, count in zip(VERDICT_NAMES[1:], totals[1:], strict=True)}
        if len(self._sensors) > 1:
            for code in (GATED, MISSING, FAILED, SCREENED):
                for sensor in np.flatnonzero(each[:, code]):
                    counts[f"{VERDICT_NAMES[code]} {self._sensors[sensor]}"] = int(each[sensor, code])
        for sensor, reason in np.argwhere(reasons):
            counts[f"{REASONS[reason]} {self._sensors[sensor]}"] = int(reasons[sensor, reason])
        return counts

    def _of(self, track: Track, channel: np.ndarray, rows: slice) -> np.ndarray:
        """Return the rows with each verdict, then each reason (columns), by sensor; verdict 0 is no measurement."""
        verdict, channel = track.verdict[rows], channel[rows]
        sensors, kinds = len(self._sensors), len(VERDICT_NAMES)
        flat = np.where(verdict == 0, 0, channel * kinds + verdict)
        each = np.bincount(flat, minlength=sensors * kinds).reshape(-1, kinds)
        return np.hstack((each, reasons_by_sensor(sensors, channel, track.screened[rows])))


def complaints(model: StateSpaceModel, channel: np.ndarray, track: Track, first: int) -> Iterator[tuple[str, str]]:
    """Yield key and text of the last measurement of each kind that was not used, from row `first` on."""
    for code, what in ((GATED, "rejected by the gate"), (MISSING, "has no value"), (FAILED, "could not be used")):
        rows = np.flatnonzero(track.verdict[first:] == code)
        if rows.size:
            row = first + int(rows[-1])
            sensor = model.sensors[channel[row]].name
            nis = f" (NIS {track.nis[row]:.3g})" if np.isfinite(track.nis[row]) else ""
            yield f"{VERDICT_NAMES[code]} {sensor}", f"{sensor}: measurement {what}{nis}"


def last_run(codes: np.ndarray) -> int:
    """Return the index of the first of the equal codes at the end of an array that is not empty."""
    end = len(codes)
    while end > 0:
        start = max(0, end - UNSETTLED)
        others = np.flatnonzero(codes[start:end] != codes[-1])
        if others.size:
            return start + int(others[-1]) + 1
        end = start
    return 0


class Latency:
    """Recent times from arrival to row."""

    def __init__(self) -> None:
        self._ms = np.zeros(LATENCIES)
        self._n = 0

    def note(self, batch: Events) -> None:
        """Note a batch that was folded."""
        arrivals = batch.arrival[batch.kind == READING]
        if not arrivals.size:
            return
        took = (time.time_ns() - arrivals[-LATENCIES:]) * 1e-6
        at = (self._n + np.arange(took.size)) % LATENCIES
        self._ms[at] = took
        self._n += took.size

    def percentile(self, percent: float) -> float | None:
        """Return a percentile, ms; None while there is none."""
        count = min(self._n, LATENCIES)
        return float(np.percentile(self._ms[:count], percent)) if count else None


def refusals(model: StateSpaceModel, log: Log, track: Track, first: int) -> Iterator[tuple[str, str]]:
    """Yield key and text of the last row that a plausibility check rejected, by sensor and reason, from `first` on."""
    found = np.argwhere(track.screened[first:])
    last = {}
    for i, k in found.tolist():
        bits, sensor = int(track.screened[first + i, k]), int(log.channel[first + i])
        for reason in range(len(REASONS)):
            if bits & (1 << reason):
                last[sensor, reason] = (first + i, k)
    for (sensor, reason), (i, k) in last.items():
        yield f"{REASONS[reason]} {model.sensors[sensor].name}", _text(model, sensor, k, reason, float(log.value[i, k]))


def _text(model: StateSpaceModel, sensor: int, k: int, reason: int, value: float) -> str:
    item = model.sensors[sensor]
    limits, unit = item.limits or Limits(), item.rows[k].unit
    name = model.row_names[model.row_start[sensor] + k]

    def ends(pairs: tuple[Pair, ...]) -> str:
        low, high = pairs[k % len(pairs)]
        return f"{low:g} to {high:g} {unit}"

    what = f"{name}: {value:.6g} {unit}"
    match REASONS[reason]:
        case "range":
            return f"{what} is outside {ends(limits.range)}; not used: look at the sensor, or widen its range"
        case "saturated":
            inside = ends(limits.saturation)
            return f"{what} is where its converter clips, {inside}; not used: the quantity may lie anywhere beyond"
        case "rate":
            most = f"{limits.rate[k % len(limits.rate)]:g} {unit}/s"
            return f"{what} is further from the last good reading than {most} allows; not used until it comes back"
        case "stuck":
            return f"{what} has been repeated for too long; not used until it changes: look at the sensor"
        case _:
            return f"{what} came again; it counts once: look for what repeats readings on their way"
