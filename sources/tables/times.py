"""Times of a table's rows: numbers in a unit, ISO 8601, other dates, and local times of a time zone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from estimators.errors import SourceError, quoted

from ..dates import CLOCK, is_day, layout, ns_of_date, ns_of_iso, since_epoch
from ..units import to_ns

if TYPE_CHECKING:
    import pyarrow

DAY_NS = 86_400 * 10**9

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "min": 60 * 10**9, "h": 3600 * 10**9, "d": DAY_NS}
"""Nanoseconds of each unit of time."""

SERIAL_DAYS = {"excel": 25_569, "matlab": 719_529}
"""Units that count days, with the number of 1970-01-01: Excel's serial date and MATLAB's datenum."""

MAX_TIME_NS = 2**62
"""Distance (146 years) of a time from 0; numbers beyond it are of another unit, or no times."""

EPOCH_S = (946_684_800, 2_840_140_800)  # 2000 and 2060
LABVIEW_S = 2_082_844_800  # From 1904-01-01, where LabVIEW counts from, to 1970
_COMPACT = re.compile(r"(?:19|20)\d{10}(?:\d\d(?:\d{3})?)?")  # 20240315080000, with or without seconds and milliseconds
_WHOLE_DAY = re.compile(r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])")  # 20240315
WHOLE_CLOCK = re.compile(r"(?:[01]\d|2[0-3])[0-5]\d[0-5]\d(?:\.\d*)?")  # 080010

_DATE_NAME = re.compile("dat(e|um)", re.IGNORECASE)  # 150324 is no clock there.

_NAMED_DAY = re.compile(r"(?<!\d)((?:19|20)\d\d)([-_.]?)(0[1-9]|1[0-2])\2(0[1-9]|[12]\d|3[01])(?!\d)")
"""A date in the name of a file."""

_OFFSET = re.compile(r"(?<![^\W_])(?:UTC|GMT)(?:\s*([+-])\s*(\d\d?)(?::?(\d\d))?)?(?![^\W_])", re.IGNORECASE)
"""An offset from UTC in a heading: Date Time, GMT-05:00; Time (UTC+1)."""

MAX_CLOCK_STEP_BACK_NS = 3600 * 10**9  # By which a clock without a date goes back within one day
TWICE, SKIPPED, ASSUMED = "hour that occurs twice", "hour that never occurs", "time assumed"
"""Keys of notes: times that follow from the order of the rows, and assumptions made once for all rows."""
TAIL_ROWS = 256  # Rows before the clock is set from which the usual interval is taken

MAX_DETECTION_CELLS = 4096  # Cells from which the order of day and month is taken


class TimeColumn(NamedTuple):
    """The column that holds the time.

    unit: Of numbers, a key of `UNITS` or `SERIAL_DAYS`. format: Of dates, as in `datetime.strptime`; None detects it.
    zone: Time zone of dates without an offset, for example Europe/Berlin or +01:00; None is that in the heading, else
    UTC. clock: Second column, of a CSV,
    whose cells follow those of the first. date: ISO date of the first row if the cells are clocks without one.
    shift: Seconds that a table adds to the times.
    """

    name: str
    unit: str = "s"
    format: str | None = None
    zone: str | None = None
    clock: str | None = None
    date: str | None = None
    shift: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Its one or two columns."""
        return (self.name,) if self.clock is None else (self.name, self.clock)

    @property
    def label(self) -> str:
        """Its columns, for messages."""
        return " and ".join(self.names)


class TimeReader:
    """Converts a time column to nanoseconds, chunk by chunk.

    A clock without a date begins at the column's `date`, or that in the name of the file `path`, and passes midnight
    when it goes back by more than an hour. Without a file, it is no time. Numbers that are too large for seconds are of
    the unit in which the first one is a time between 2000 and 2060; those that all spell a date (20240315) or a clock
    (080010) are read so. `notes` are rows of the last chunk whose time was assumed: row, key, text. `zoneless` tells
    whether there was a date without a time zone.

    Raises:
        SourceError: If dates may be day/month as well as month/day, or the zone is unknown.
    """

    def __init__(self, column: TimeColumn, path: Path | None = None) -> None:
        self._column = column
        self.notes: list[tuple[int, str, str]] = []
        self.unit = column.unit
        named = _NAMED_DAY.search(path.name) if path is not None else None
        date = column.date or ("-".join(named.group(1, 3, 4)) if named else None)
        alone = path is not None and column.clock is None
        self._midnight = (ns_of_iso(date) or (0, True))[0] if date and alone else 0 if alone else None
        self._undated, self._clock = date is None, 0
        self._day: str | None = ""  # the last cell; None once a date without a clock has been noted
        days = SERIAL_DAYS.get(column.unit)
        self._factor, self._days = (UNITS[column.unit], False) if days is None else (DAY_NS, True)
        self._seconds = column.unit == "s"  # until the first number shows that they are
        self._spelt: str | None = None if self._seconds and column.format is None else ""  # what numbers spell
        self._origin = days or 0
        self._order: str | None = None
        self.zoneless, self._heading, zone = False, None, column.zone
        if zone is None and (offset := _OFFSET.search(column.label)):
            self._heading = zone = f"{offset[1] or '+'}{offset[2] or '0':0>2}:{offset[3] or '00'}"
        self._summer = _SummerTime(column._replace(zone=zone), self.notes) if zone is not None else None

    def read(self, cells: list[str] | pyarrow.Array) -> tuple[np.ndarray, np.ndarray]:
        """Return times (ns), and a mask of the rows that have one.

        Args:
            cells: Cells of a CSV as text, or a column of pyarrow: numbers, timestamps or text.
        """
        if isinstance(cells, list):
            return self._of_cells(cells)
        import pyarrow

        kind = cells.type
        known = ~cells.is_null().to_numpy(zero_copy_only=False)
        if pyarrow.types.is_timestamp(kind) or pyarrow.types.is_date(kind):
            zone = getattr(kind, "tz", None)
            whole = cells.cast(pyarrow.timestamp("ns", zone)).cast(pyarrow.int64())
            t = whole.fill_null(0).to_numpy(zero_copy_only=False)
            return self._local(t, known & (zone is None)), known
        numeric = pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind)
        if numeric and self._spelt != "":
            texts = ["" if item is None else f"{item:.15g}" for item in cells.to_pylist()]
            if self._spelt or self._spells(texts):
                return self._of_cells(texts)
        if self._seconds and numeric and known.any():
            self._fit_unit(float(cells.drop_null()[0].as_py()))
        if pyarrow.types.is_integer(kind) and not self._origin:
            whole = cells.cast(pyarrow.int64()).fill_null(0).to_numpy(zero_copy_only=False)
            known = known & (np.abs(whole) <= MAX_TIME_NS // self._factor)
            return np.where(known, whole, 0) * self._factor, known
        if numeric:
            numbers = cells.cast(pyarrow.float64()).to_numpy(zero_copy_only=False) - self._origin
            known = known & (np.abs(numbers) <= MAX_TIME_NS / self._factor)
            t = to_ns(np.where(known, numbers, 0.0) * (self._factor / 1e9))
            return (self._local(t, known) if self._days else t), known
        return self._of_cells([item or "" for item in cells.cast(pyarrow.string()).to_pylist()])

    def is_date(self, cell: str) -> bool:
        """Return whether a cell is a date, day or month first."""
        return self._of_text(cell) is not None or layout(cell) is not None

    def _of_cells(self, cells: list[str]) -> tuple[np.ndarray, np.ndarray]:
        if self._order is None and self._column.format is None:
            self._order = _day_and_month(self._column.label, cells)
        if self._spelt is None:
            self._spells(cells)
        t = np.zeros(len(cells), np.int64)
        known, naive = np.zeros((2, len(cells)), np.bool_)
        for k, cell in enumerate(cells):
            found = self._of_text(f"20{cell}" if self._order == "year" else cell)
            if found is not None and abs(found[0]) <= MAX_TIME_NS:
                (t[k], naive[k]), known[k] = found, True
            if cell == self._day and is_day(cell):
                rule = "a date without a clock: they all have its midnight; name the clock's column too (time.column)"
                self.notes.append((k, ASSUMED, f"{self._column.label} is {quoted(cell)} in several rows, {rule}"))
                self._day = None
            elif self._day is not None:
                self._day = cell
        return self._local(t, naive), known

    def _of_text(self, text: str) -> tuple[int, bool] | None:
        """Return one cell as ns, and whether that is local time; a number is taken exactly as it is written."""
        if self._column.format is not None:
            try:
                when = datetime.strptime(text, self._column.format)
            except ValueError:
                return None
            t, naive = since_epoch(when)
            alone = self._midnight is not None and (when.year, when.month, when.day) == (1900, 1, 1)
            return self._of_clock(t % DAY_NS) if alone else (t, naive)
        try:
            number = float(text if "_" not in text else "")  # 1_000 is a number in Python only.
        except ValueError:
            if CLOCK.fullmatch(text) and self._midnight is not None:
                clock = ns_of_date(f"1970/01/01 {text}", False)
                return clock and self._of_clock(clock[0])
            return ns_of_iso(text) or ns_of_date(text, self._order == "month")
        if not np.isfinite(number):
            return None
        if self._spelt == "clock":
            clock = ns_of_date(f"1970/01/01 {_padded(text)}", False)
            return clock and self._of_clock(clock[0])
        if self._spelt == "day":
            return ns_of_date(text, False)
        if self._seconds and _COMPACT.fullmatch(text):
            return ns_of_date(f"{text[:8]} {text[8:12]}{text[12:14] or '00'}.{text[14:] or '0'}", False)
        if self._seconds:
            self._fit_unit(number)
        return int(((Decimal(text) - self._origin) * self._factor).to_integral_value()), self._days

    def _spells(self, cells: list[str]) -> str:
        """Return and keep what the numbers of the first rows spell: "day", "clock", or nothing.

        A clock goes from 59 to 100, or from 5959 to 10000, in a usual step of seconds, but no usual one of numbers.
        """
        cells, self._spelt = [cell for cell in cells if cell], ""
        if cells and all(_WHOLE_DAY.fullmatch(cell) and ns_of_date(cell, False) for cell in cells):
            self._spelt = "day"
            self.notes.append((0, ASSUMED, f"{self._column.label} is {cells[0]}, taken as a date"))
        elif (
            cells
            and self._midnight is not None
            and not _DATE_NAME.search(self._column.label)
            and all(WHOLE_CLOCK.fullmatch(_padded(cell)) for cell in cells)
        ):
            numbers = np.array(cells, float)
            seconds = numbers - 40.0 * (numbers // 100) - 2400.0 * (numbers // 10_000)
            steps, clocks = np.diff(numbers), np.diff(seconds)
            least = np.min(steps, where=steps > 0.0, initial=np.inf)
            most = 2.0 * np.median(clocks) if clocks.size else 0.0
            passed = (steps - clocks > 39.0) & (steps > 1.5 * least) & (clocks <= most)
            if passed.any() or any(len(cell.partition(".")[0]) == 6 and cell[0] == "0" for cell in cells):
                self._spelt = "clock"
        return self._spelt

    def _fit_unit(self, number: float) -> None:
        """Take the unit of the times from the first of them, if that is too large for seconds."""
        self._seconds = False
        if EPOCH_S[1] < number <= EPOCH_S[1] + LABVIEW_S:
            self._origin, when = LABVIEW_S, datetime.fromtimestamp(number - LABVIEW_S, UTC)
            text = f"{self._column.label} is {number:.0f}, taken as seconds since 1904, as of LabVIEW ({when:%Y-%m-%d})"
            self.notes.append((0, ASSUMED, text))
        for unit in ("ms", "us", "ns"):
            t = number * UNITS[unit] / 1e9
            if abs(number) * 1e9 > MAX_TIME_NS and EPOCH_S[0] <= t <= EPOCH_S[1]:
                self.unit, self._factor, when = unit, UNITS[unit], datetime.fromtimestamp(t, UTC)
                text = f"{self._column.label} is {number:.0f}, taken as {unit} since 1970 ({when:%Y-%m-%d %H:%M} UTC)"
                self.notes.append((0, ASSUMED, f"{text}; set the time's unit (time.unit, --time-unit) to be sure"))

    def _of_clock(self, clock: int) -> tuple[int, bool]:
        """Return a clock (ns) on the day on which it follows the rows before it."""
        assert self._midnight is not None
        if clock < self._clock - MAX_CLOCK_STEP_BACK_NS:
            self._midnight += DAY_NS
        self._clock = clock
        if self._undated:
            self._undated = False
            text = f"{self._column.label} is a clock without a date, counted from 1970-01-01; give it in time.date"
            self.notes.append((0, ASSUMED, text))
        return self._midnight + clock, True

    def _local(self, t: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return times in UTC; those in the mask `local` are of the zone."""
        if self._summer is None or not local.any():
            self.zoneless |= bool(local.any())
            return t
        if self._heading not in (None, "+00:00"):
            text = f"{self._column.label} is taken as local time of UTC{self._heading}, by its heading"
            self.notes.append((0, ASSUMED, f"{text}; set the time's zone (time.zone, --time-zone) to be sure"))
            self._heading = None
        t = t.copy()
        rows = np.flatnonzero(local)
        t[rows] = self._summer.to_utc(t[rows], rows)
        return t


def _padded(cell: str) -> str:
    """Return a number as hours, minutes and seconds of two digits each: 080010.5 of 80010.5."""
    whole, dot, fraction = cell.partition(".")
    return whole.zfill(6) + (dot + fraction if fraction.strip("0") else "")


class _SummerTime:
    """Converts local times to UTC by the order of their rows.

    - An hour that occurs twice, when the clock is set back, is the first one until times run backwards. In rows that
      are sorted by local time each time has the rows of both hours, twice as many as usual: half are of the first.
    - An hour that does not exist is of a clock that was not set forward, and so are the rows after it, if that
      continues the interval of the rows before.
    """

    def __init__(self, column: TimeColumn, notes: list[tuple[int, str, str]]) -> None:
        self._column, self._notes, self._sorted = column, notes, False
        self._usual = self._interval = 0  # rows of one time, 0 if that changes, and ns from one to the next
        self._at, self._run, self._last = -MAX_TIME_NS, 0, -MAX_TIME_NS  # last local time, its rows so far, and its UTC
        self._fixed: int | None = None  # offset (ns) of a clock that was not set forward
        self._skipped: int | None = None  # its offset, while the last row is in an hour that does not exist

    def to_utc(self, naive: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return local times (ns) of rows of a chunk in UTC."""
        import pyarrow
        import pyarrow.compute

        local = pyarrow.array(naive, pyarrow.timestamp("ns"))
        first, second = (
            pyarrow.compute.assume_timezone(local, self._column.zone, ambiguous=which, nonexistent=which)
            .cast(pyarrow.int64())
            .to_numpy()
            for which in ("earliest", "latest")
        )
        odd, twice = first != second, second - first > 1
        regular = naive[: int(np.argmax(odd)) if odd.any() else None][-TAIL_ROWS:]
        times, counts = np.unique(regular, return_counts=True)
        if times.size > 3:  # the first and the last may be incomplete
            self._usual = int(counts[1]) if np.ptp(counts[1:-1]) == 0 else 0
            self._interval = int(np.median(np.diff(times)))
        if twice.any():
            counts = np.unique(naive[twice], return_counts=True)[1]
            counts[0] += self._run if naive[0] == self._at else 0
            doubled = np.append(counts[:-1] == 2 * self._usual, counts[-1] > self._usual)
            in_order = self._usual > 0 and not np.any(np.diff(naive[twice]) < 0)
            self._sorted = in_order and bool((self._sorted and odd[0]) or doubled.mean() >= 0.5)
        found = first.copy() if self._fixed is None else naive - self._fixed
        if odd.any() or self._skipped is not None:
            for k, t in enumerate(naive.tolist()):
                self._at, self._run = t, self._run + 1 if t == self._at else 1
                found[k] = self._last = self._choose(t, int(first[k]), int(second[k]), int(rows[k]))
        self._at, self._run, self._last = int(naive[-1]), int(np.sum(naive == naive[-1])), int(found[-1])
        return found

    def _choose(self, t: int, first: int, second: int, row: int) -> int:
        """Return the UTC of a local time that is one of two, or neither."""
        zone, shown = self._column.zone, f"{self._column.label} {np.datetime64(t // 10**9, 's')}"
        if second - first == 1:  # the last moment before an hour that does not exist, and the first one after it
            before = datetime.fromtimestamp(first // 10**9, ZoneInfo(str(zone))).utcoffset() or timedelta()
            self._skipped = before // timedelta(seconds=1) * 10**9
            rule = "taken for a clock that was not set forward"
            self._notes.append((row, SKIPPED, f"{shown} does not exist in {zone}; {rule}"))
            return t - self._skipped
        if self._skipped is not None and self._fixed is None:
            steps = [abs(utc - self._last - self._interval) for utc in (t - self._skipped, first)]
            if steps[0] < steps[1]:
                self._fixed = self._skipped
                text = f"give the time's zone Etc/GMT{-self._fixed // (3600 * 10**9):+d}"
                text = f"from {shown} on the clock is taken to be never set forward; if so, {text}"
                self._notes.append((row, ASSUMED, text))
        self._skipped = None
        if self._fixed is not None or first == second:
            return first if self._fixed is None else t - self._fixed
        late = self._run > self._usual if self._sorted else first < self._last
        text = f"taken as the {'second' if late else 'first'} one by the order of the rows"
        self._notes.append((row, TWICE, f"{shown} occurs twice in {zone}; {text}"))
        return second if late else first


_SHORT = re.compile(r"(\d\d)-(\d\d)-(\d\d)(?!\d)")  # 24-03-15


def _day_and_month(name: str, cells: Sequence[str]) -> str:
    """Return which comes first in dates such as 25.10.2020: "day" or "month", or "year" of two digits.

    Raises:
        SourceError: If the cells do not show it.
    """
    unclear, words = None, ("day{0}month", "month{0}day")
    short = [match.groups() for match in map(_SHORT.match, islice(cells, MAX_DETECTION_CELLS)) if match]
    if short and all(middle < "13" and last < "32" for _, middle, last in short):
        firsts, lasts = ({one[k] for one in short} for k in (0, 2))
        if len(lasts) > len(firsts) or max(firsts) > "31":  # The day changes more often than the year.
            return "year"
        if len(lasts) == len(firsts) and max(firsts) > "12" and firsts != lasts:
            unclear, words = next(filter(_SHORT.match, cells)), ("year-month-day", "day-month-year")
    for cell in cells[: 0 if unclear else MAX_DETECTION_CELLS]:
        found = layout(cell)
        if found is None or not found.either:
            continue
        first, second = map(int, re.findall(r"\d+", cell)[:2])
        if "." in cell[:3] or first > 12:
            return "day"
        if second > 12:
            return "month"
        unclear = unclear or cell
    if unclear is None:
        return "day"
    found = layout(unclear)
    assert found is not None
    separator, year = unclear.lstrip("0123456789")[0], "%y" if found.digits == 2 else "%Y"
    orders = {"d": ("%d", "%m", year), "m": ("%m", "%d", year), "y": (year, "%m", "%d")}
    formats = [separator.join(orders[word[0]]) for word in words]
    directives = iter(("%I" if found.half else "%H", "%M", "%S", "%f"))
    _, rest = re.split(r"^\d+\D+\d+\D+\d+", unclear)
    clock = re.sub(r"[AP]M", "%p", re.sub(r"\d+", lambda _: next(directives), rest, count=len(found.clock)), flags=re.I)
    raise SourceError(
        f"{name} is {quoted(unclear)}, which may be {' or '.join(words).format(separator)}; set the time's format "
        f'(time.format, --time-format): "{formats[0]}{clock}" or "{formats[1]}{clock}"'
    )
