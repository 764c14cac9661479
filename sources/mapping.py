"""Map values to events: units, conditions and kinds, the same for frames of a bus and rows of a table."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numba import types

from estimators.errors import LARGEST
from estimators.log import INPUT, READING, TRUTH, Events
from estimators.numerics.jit import B1, F1, F2, I1, i64, jit

from .source import Accuracy, Channel, Report
from .units import conversion, declared_conversion, spread_factor

PRESENT, ABSENT, SHORT = range(3)
"""The value is present; the frame does not carry the signal (multiplexing); the frame ends before it."""


class Tables(NamedTuple):
    """Channels of all groups (messages, or one table), one a row; see `ChannelMapping`.

    `own_slot` is the position of a row's own accuracy, -1 if it has none.
    """

    group: np.ndarray
    kind: np.ndarray
    target: np.ndarray
    row: np.ndarray
    slot: np.ndarray
    factor: np.ndarray
    shift: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    own_slot: np.ndarray
    own_factor: np.ndarray
    own_squared: np.ndarray
    where: np.ndarray
    where_slot: np.ndarray
    selects: np.ndarray
    low: np.ndarray
    high: np.ndarray


INT_COLUMNS = ("group", "kind", "target", "row", "slot", "own_slot", "own_squared", "where", "where_slot", "selects")
"""Columns of `Tables` that are int64; the others are float64."""

tables_type = types.NamedTuple([I1 if name in INT_COLUMNS else F1 for name in Tables._fields], Tables)
emit_signature = i64(
    tables_type, I1, B1, F2, types.Array(types.int8, 2, "C"), i64, I1, B1, types.int32[::1], F2, I1, I1, I1, I1
)


@jit
def _own_variance(tables, r, values, state, i):
    """Return the noise variance of row r that frame i reports; NaN if it reports none, infinity if it is unknown.

    A value that is no number, negative, as in messages of ROS, or beyond any variance is unknown.
    """
    slot = tables.own_slot[r]
    own = tables.own_factor[r] * values[i, slot]
    if state[i, slot] != PRESENT:
        return np.nan
    if not own >= 0.0:
        return np.inf
    if tables.own_squared[r] == 0:
        own *= own
    return np.inf if own > LARGEST else own if own > 0.0 else np.nan


@jit
def emit(tables, plan, skip, values, state, width, source, kind, channel, value, refused, cut, unreported, unknown):
    """Write the events of each frame: inputs as one event, then measurements, then true states in blocks.

    Returns their number. A block begins with a known state and extends over the width of an event. Columns of `value`
    from `width` on hold reported variances.
    """
    n = 0
    for i in range(plan.size):
        g = plan[i]
        if g < 0 or skip[i] != 0:
            continue
        input_event = truth_event = -1
        for c in range(tables.group[g], tables.group[g + 1]):
            reported = False
            for r in range(tables.row[c], tables.row[c + 1]):
                here = state[i, tables.slot[r]]
                reported = reported or here != ABSENT
                if here == SHORT:
                    cut[c] += 1
            if not reported:
                continue
            good, selected = True, True
            for w in range(tables.where[c], tables.where[c + 1]):
                tested = values[i, tables.where_slot[w]]
                if state[i, tables.where_slot[w]] != PRESENT or not (tables.low[w] <= tested <= tables.high[w]):
                    good = False
                    selected = selected and tables.selects[w] == 0
            if not selected:
                continue
            if not good:
                refused[c] += 1
                if tables.kind[c] != READING:
                    continue
            if tables.kind[c] == INPUT and input_event >= 0:
                event = input_event
            elif tables.kind[c] == TRUTH and truth_event >= 0 and tables.target[c] < channel[truth_event] + width:
                event = truth_event
            else:
                event = n
                source[n] = i
                kind[n] = tables.kind[c]
                channel[n] = 0 if tables.kind[c] == INPUT else tables.target[c]
                for column in range(value.shape[1]):
                    value[n, column] = np.nan
                n += 1
                if tables.kind[c] == INPUT:
                    input_event = event
                elif tables.kind[c] == TRUTH:
                    truth_event = event
            if good:
                vague = lost = False
                for r in range(tables.row[c], tables.row[c + 1]):
                    converted = tables.factor[r] * values[i, tables.slot[r]] + tables.shift[r]
                    column = r - tables.row[c]
                    if tables.kind[c] == INPUT:
                        column = tables.target[c]
                    elif tables.kind[c] == TRUTH:
                        column = tables.target[c] - channel[event]
                    final = tables.scale[r] * converted + tables.offset[r]
                    value[event, column] = final if np.isfinite(final) else np.nan
                    if tables.own_slot[r] >= 0 and np.isfinite(final):
                        own = _own_variance(tables, r, values, state, i)
                        if np.isinf(own):
                            value[event, column] = own = np.nan
                            lost = True
                        else:
                            vague = vague or np.isnan(own)
                        value[event, width + column] = own
                if vague:
                    unreported[c] += 1
                if lost:
                    unknown[c] += 1
                if tables.kind[c] == TRUTH and np.isnan(value[event, 0]):
                    n -= 1
                    truth_event = -1
    return n


MAX_HOLDS = 100_000  # Sensors of assets whose last value is known, for those with `repeats`
MAX_PERIODS = 2**40  # Periods of one hold
PERIOD_SLACK = 0.01  # Of a period, by which a row may be early


class Hold(NamedTuple):
    """Last value of a sensor (1, rows), when it came first, ns, and the periods since then that have a measurement."""

    value: np.ndarray
    start: int
    periods: int


def first_of_hold(t: np.ndarray, value: np.ndarray, period: float, last: Hold | None = None) -> tuple[np.ndarray, Hold]:
    """Return which values are the first of a hold, or of a further period of it, and the last hold. NaN equals NaN.

    Args:
        t: Times, ns, (n,), n > 0.
        value: (n, rows).
        period: Seconds; 0 for the first values only.
        last: Hold before the first value, which may go on.
    """
    if last is not None:
        t, value = np.append(last.start, t), np.vstack((last.value, value))
    differs = np.any((value[1:] != value[:-1]) & ~(np.isnan(value[1:]) & np.isnan(value[:-1])), axis=1)
    # A clock that was set back begins a hold.
    first = np.append(True, differs | (t[1:] < t[:-1] - (period or 1.0) * 1e9))
    start = t[np.maximum.accumulate(np.where(first, np.arange(t.size), 0))]
    periods = np.zeros(t.size, np.int64)
    if period:
        periods = np.clip(np.floor((t - start) / (period * 1e9) + PERIOD_SLACK), 0, MAX_PERIODS - 1).astype(np.int64)
    periods[0] = 0 if last is None else last.periods
    hold = MAX_PERIODS * np.cumsum(first)
    used = np.maximum.accumulate(hold + periods)
    new: np.ndarray = np.append(last is None, used[1:] > used[:-1])
    return new[int(last is not None) :], Hold(value[-1:].copy(), int(start[-1]), int(used[-1] - hold[-1]))


class ChannelMapping:
    """Maps rows of values to events.

    Args:
        groups: For each message (or the one table): its channels, the names of its values in their order, and the
            unit that each value has where the channel declares none.
        width: Value columns of an event.
        report: Receives measurements that a condition rejected, short frames, and missing accuracies.

    Raises:
        SourceError: If a unit does not convert to the model's.
    """

    def __init__(
        self,
        groups: Sequence[tuple[Sequence[Channel], Sequence[str], Sequence[str | None]]],
        *,
        width: int,
        report: Report,
    ) -> None:
        self._width = width
        self._report = report
        order = (INPUT, READING, TRUTH)
        self._channels: list[Channel] = []
        tables = SimpleNamespace(**{name: [] for name in Tables._fields})
        for starts in (tables.group, tables.row, tables.where):
            starts.append(0)
        for channels, names, units in groups:
            positions = {name: k for k, name in enumerate(names)}
            # True states in order, for the blocks.
            for channel in sorted(channels, key=lambda c: (order.index(c.kind), c.index if c.kind == TRUTH else 0)):
                self._channels.append(channel)
                tables.kind.append(channel.kind)
                tables.target.append(channel.index)
                for k, name in enumerate(channel.signals):
                    tables.slot.append(positions[name])
                    wanted = "deg" if channel.convert else channel.model_units[k]
                    found = units[positions[name]]
                    factor, shift = declared_conversion(channel.units[k], found, wanted, f"{channel.name}: {name}")
                    tables.factor.append(factor)
                    tables.shift.append(shift)
                    # Scale and offset of a position apply to metres, not to degrees.
                    tables.scale.append(1.0 if channel.convert else channel.scale[k])
                    tables.offset.append(0.0 if channel.convert else channel.offset[k])
                    own = channel.accuracy
                    at = positions[own.signals[k]] if own is not None else -1
                    tables.own_slot.append(at)
                    tables.own_factor.append(0.0 if own is None else _own_factor(channel, own, k, units[at]))
                    tables.own_squared.append(own is not None and own.squared)
                tables.row.append(len(tables.slot))
                for condition in (*channel.where, *channel.only):
                    tables.where_slot.append(positions[condition.signal])
                    tables.selects.append(condition in channel.only)
                    tables.low.append(condition.low)
                    tables.high.append(condition.high)
                tables.where.append(len(tables.where_slot))
            tables.group.append(len(self._channels))
        self._tables = Tables(
            **{
                name: np.array(column, np.int64 if name in INT_COLUMNS else np.float64)
                for name, column in vars(tables).items()
            }
        )
        self._columns = width + max((len(c.signals) for c in self._channels if c.accuracy is not None), default=0)
        # Kept, as a frame of a live bus is often alone: allocations would cost as much as its conversion.
        self._counts = np.zeros((4, len(self._channels)), np.int64)
        self._losses = tuple(self._counts)
        self._most = int(np.diff(self._tables.group).max(initial=0))
        # By sensor: a message with two ids has its channels twice here.
        self._positions = {c.index: c for c in self._channels if c.convert == "east_north"}
        self._origins = {index: channel.origin for index, channel in self._positions.items()}
        self._thinned = {c.index: c for c in self._channels if c.kind == READING and c.repeats is not None}
        self._holds: dict[tuple[int, str], Hold] = {}
        self._said: set[int] = set()

    def events(
        self,
        plan: np.ndarray,
        t: np.ndarray,
        arrival: np.ndarray,
        values: np.ndarray,
        state: np.ndarray,
        skip: np.ndarray,
        assets: np.ndarray | None = None,
    ) -> tuple[Events, np.ndarray]:
        """Return the events of rows of values, and the row of each.

        Args:
            plan: Group of each row, (n,); -1 for none.
            t: Measurement times, ns.
            arrival: Arrival times, ns.
            values: (n, most values of a group), NaN is missing.
            state: Same shape: PRESENT, ABSENT or SHORT.
            skip: (n,), nonzero for rows to leave out.
            assets: Name of the asset of each row, (n,), for a fleet.
        """
        room = plan.size * self._most
        source = np.empty(room, np.int64)
        kind, channel = np.empty(room, np.int8), np.empty(room, np.int32)
        value = np.empty((room, self._columns))
        out = source, kind, channel, value
        n = emit(self._tables, plan, skip, values, state, self._width, *out, *self._losses)
        if n < room:
            source, kind, channel, value = source[:n], kind[:n].copy(), channel[:n].copy(), value[:n].copy()
        batch = Events(t[source], arrival[source], kind, channel, value)
        if np.count_nonzero(self._counts):
            self._report_losses()
            self._counts[:] = 0
        for thinned in self._thinned.values():
            new = self._new(batch, thinned, None if assets is None else assets[source])
            batch, source = batch.select(new), source[new]
        for item in self._positions.values():
            self._place(batch, item)
        return batch, source

    def _report_losses(self) -> None:
        for channel, counts in zip(self._channels, self._counts.T, strict=True):
            name, own = channel.name, channel.accuracy
            rule = " and ".join(map(str, channel.where))
            reported = ", ".join(dict.fromkeys(own.signals)) if own is not None else ""
            what = "variance" if own is not None and own.squared else "standard deviation"
            losses = {  # In the order of the counts
                "condition": f"measurement rejected; it needs {rule}",
                "short frame": f"a frame of {channel.message} ends before {', '.join(channel.signals)}",
                "accuracy": f"{reported} has no positive {what} of a measurement; the tuned R is used",
                "unknown accuracy": f"{reported} is no number, negative or too large for a {what}; value is missing",
            }
            for count, (key, text) in zip(counts, losses.items(), strict=True):
                for _ in range(count):
                    self._report(f"{key} {name}", f"{name}: {text}")

    def _new(self, batch: Events, channel: Channel, assets: np.ndarray | None) -> np.ndarray:
        """Return the mask of all events but the repeats of a channel's values."""
        new = np.ones(len(batch), np.bool_)
        value = batch.value[:, : len(channel.signals)]
        rows = np.flatnonzero((batch.kind == READING) & (batch.channel == channel.index) & ~np.isnan(value).all(axis=1))
        for name in [""] if assets is None else set(assets[rows].tolist()):
            own = rows if assets is None else rows[assets[rows] == name]
            if own.size:
                key = channel.index, name
                last = self._holds.pop(key, None)
                new[own], self._holds[key] = first_of_hold(batch.t[own], value[own], channel.repeats or 0.0, last)
        while len(self._holds) > MAX_HOLDS:
            self._holds.pop(next(iter(self._holds)))
        left_out = int(new.size - np.count_nonzero(new))
        for _ in range(left_out):
            rule = f"every {channel.repeats:g} s" if channel.repeats else "changes"
            text = "" if channel.index in self._said else f"{channel.name}: repeats are left out (repeats: {rule})"
            self._said.add(channel.index)
            self._report(f"repeats {channel.name}", text)
        return new

    def _place(self, batch: Events, channel: Channel) -> None:
        """Convert latitude and longitude to east and north in place; the first valid fix is the default origin."""
        rows = batch.of_sensor(channel.index)
        if not rows.size:
            return
        fixes = batch.value[rows, :2]
        if self._origins[channel.index] is None:
            valid = np.flatnonzero(_on_earth(fixes))
            if not valid.size:
                batch.value[rows, :2] = np.nan
                return
            first = fixes[valid[0]]
            self._origins[channel.index] = (float(first[0]), float(first[1]))
        origin = self._origins[channel.index]
        assert origin is not None
        metres = east_north(fixes, origin)
        for k in range(2):
            factor, shift = conversion("m", channel.model_units[k], channel.name)
            batch.value[rows, k] = channel.scale[k] * (factor * metres[:, k] + shift) + channel.offset[k]


def _own_factor(channel: Channel, own: Accuracy, k: int, unit: str | None) -> float:
    """Return the factor of a reported accuracy of row k, whose unit is `unit` unless the channel declares one."""
    where = f"{channel.name}: {own.signals[k]}"
    return own.scale[k] * spread_factor(own.units[k] or unit, channel.model_units[k], where, squared=own.squared)


SEMI_MAJOR = 6378137.0  # WGS84, m
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def _earth_fixed(latitude: np.ndarray, longitude: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the ellipsoid; angles in radians."""
    normal = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    x = normal * np.cos(latitude) * np.cos(longitude)
    y = normal * np.cos(latitude) * np.sin(longitude)
    return x, y, normal * (1 - ECCENTRICITY2) * np.sin(latitude)


def _on_earth(fixes: np.ndarray) -> np.ndarray:
    """Return which fixes (n, 2), in degrees, are a latitude and a longitude."""
    return (np.abs(fixes) <= (90, 180)).all(axis=1)


def east_north(fixes: np.ndarray, origin: tuple[float, float]) -> np.ndarray:
    """Metres east and north of the origin, in the plane that touches the WGS84 ellipsoid there.

    N = a / √(1 - e² sin²φ);  r = (N cosφ cosλ, N cosφ sinλ, N (1 - e²) sinφ);
    east = -sinλ₀ dx + cosλ₀ dy;  north = -sinφ₀ cosλ₀ dx - sinφ₀ sinλ₀ dy + cosφ₀ dz,  (dx, dy, dz) = r - r₀

    A point at the distance d over ground appears short by d (d/R)²/6: 4 μm at 1 km, 0.26 m at 40 km. Scaling the angles
    by the radii of curvature at the origin is true at the origin only: its east is wrong by 0.5 % when 20 km north of
    it at 56° latitude.

    Args:
        fixes: Latitude and longitude, degrees, shape (n, 2). NaN, or what is no latitude or longitude, gives NaN.
        origin: Latitude and longitude, degrees.

    Source: NIMA TR8350.2 (2000), section 4; Groves (2013), Principles of GNSS, equations 2.112 and 2.150.
    """
    latitude, longitude = np.radians(np.where(_on_earth(fixes), fixes.T, np.nan))
    lat0, lon0 = np.radians(np.asarray(origin, float))
    dx, dy, dz = (a - b for a, b in zip(_earth_fixed(latitude, longitude), _earth_fixed(lat0, lon0), strict=True))
    east = -np.sin(lon0) * dx + np.cos(lon0) * dy
    north = -np.sin(lat0) * (np.cos(lon0) * dx + np.sin(lon0) * dy) + np.cos(lat0) * dz
    return np.column_stack((east, north))
