"""Dates as people and programs spell them, read by the shape of the cell; ISO 8601 is read by the standard library.

dateutil and dateparser read fewer of these spellings, take minutes for a million cells that all differ, and fill what a
cell lacks from today. Here a cell is a date only if all of it is understood.
"""

from __future__ import annotations

import re
from calendar import isleap
from datetime import UTC, datetime
from functools import lru_cache
from typing import NamedTuple

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NAIVE_EPOCH = datetime(1970, 1, 1)
_EPOCH_DAY = _NAIVE_EPOCH.toordinal()

_MONTHS = {
    name: k
    for k, names in enumerate(
        (
            "jan january januar jänner janvier janv gennaio gen enero ene",
            "feb february februar feber février févr fév febbraio febrero",
            "mar march märz mär mrz mars marzo",
            "apr april avril avr aprile abril abr",
            "may mai maggio mag mayo",
            "jun june juni juin giugno giu junio",
            "jul july juli juillet juil luglio lug julio",
            "aug august août aou agosto ago",
            "sep sept september septembre settembre set septiembre setiembre",
            "oct october oktober okt octobre ottobre ott octubre",
            "nov november novembre noviembre",
            "dec december dezember dez décembre déc dicembre dic diciembre",
        ),
        start=1,
    )
    for name in names.split()
}
"""Months and their abbreviations in English, German, French, Italian and Spanish."""

_IGNORED = frozenset(
    "mon monday tue tuesday wed wednesday thu thursday fri friday sat saturday sun sunday "
    "mo montag di dienstag mi mittwoch do donnerstag fr freitag sa samstag sonnabend so sonntag "
    "lun lundi mardi mer mercredi jeu jeudi ven vendredi sam samedi dim dimanche "
    "lunedì martedì mercoledì gio giovedì venerdì sab sabato dom domenica "
    "lunes martes mié miércoles jue jueves vie viernes sáb sábado domingo "
    "t th st nd rd of at um uhr à le de del las alle ore dt".split()
)
"""Days of the week, which say nothing that the date does not, and words between date and clock."""

_ZONES = dict(
    z=0, utc=0, gmt=0, ut=0, wet=0, west=60, cet=60, mez=60, cest=120, mesz=120, eet=120, eest=180, jst=540,
    edt=-240, est=-300, cdt=-300, mdt=-360, mst=-420, pdt=-420, pst=-480,
)  # fmt: skip
"""Minutes by which zones are ahead of UTC. CST, IST and BST each name several zones."""

_CLOCK = (
    r"(?P<clock>[12]:[12](?::[12](?:[.,][1-9]|:3)?)?|[12](?P<dot>[.-])[12](?P=dot)[12](?:[.,:][1-9])?"
    r"|[46](?:[.,][1-9])?)(?: ?(?P<half>[AP]))?"
)
_ZONE = r"(?: ?(?P<zone>Z))?(?: ?(?P<offset>[+-](?:2:2|[124]))(?: ?Z)?)?"
_FORMS = tuple(
    re.compile(form)
    for form in (
        rf"(?P<year>4)(?P<sign>[-/. ])(?P<month>[12M])(?P=sign)(?P<day>[12])(?:[ ,_-]{_CLOCK}{_ZONE})?",
        rf"(?P<day>[12])(?P<sign>[-/. ])(?P<month>[12M])(?P=sign)(?P<year>[24])(?:(?:[ ,_-]|(?<=/4):){_CLOCK}{_ZONE})?",
        rf"(?P<month>M)(?P<sign>[-/. ])(?P<day>[12])(?P=sign)(?P<year>4)(?:[ ,_-]{_CLOCK}{_ZONE})?",
        rf"(?P<month>M) (?P<day>[12]) {_CLOCK}{_ZONE} (?P<year>4)",
        rf"(?P<year>4)[-/](?P<nth>3)[ ,_-]{_CLOCK}{_ZONE}",
        rf"(?P<whole>8)(?:[ ,_-]{_CLOCK}{_ZONE})?",
    )
)
"""Forms of a date whose numbers are replaced by their counts of digits and its words by their meaning: month M, half of
the day A or P, zone Z. `nth` is the day of the year, `whole` is written as 20240315."""

CLOCK = re.compile(
    r"\d{1,2}(?::\d{2}(?::\d{2}(?:[.,]\d{1,9}|:\d{3})?)?|\.\d{2}\.\d{2}(?:[.,:]\d{1,9})?)(?:\s*[AaPp]\.?[Mm]\.?)?"
)
"""A clock without a date: 13:05, 1:05:00.250 PM, 08.00.00."""

_NUMBER, _WORD = re.compile(r"\d+"), re.compile(r"[^\W\d_]+")
_HALF = re.compile(r"(?<![^\W\d_])([ap])\.?\s?m\b\.?", re.IGNORECASE)
_PLACE = re.compile(r"\s*(\[[\w/+-]+\]|\([\w ]+\))$")  # [Europe/Berlin] of Java, (Central European Time) of JavaScript
_ZEROS = str.maketrans("123456789", "000000000")


class _Layout(NamedTuple):
    """Places of a date's parts among the numbers of its cell; None of those that it has not.

    `named` is the month if that is a word. `clock` holds the places of hour, minute, second and fraction. `minutes` are
    those by which the zone is ahead of UTC, `sign` and `offset` are of an offset in numbers. `digits` are of the year.
    """

    year: int | None
    month: int | None
    day: int | None
    nth: int | None
    whole: int | None
    named: int
    clock: tuple[int, ...]
    half: str | None
    minutes: int | None
    sign: int
    offset: tuple[int, ...]
    either: bool
    """Whether the month may as well come before the day."""
    digits: int


@lru_cache(maxsize=4096)
def _layout(cell: str) -> _Layout | None:
    """Return the layout of a cell whose digits are zeros; None if it is no date."""
    bare = _PLACE.sub("", cell)
    named = 0
    minutes: int | None = None

    def code(match: re.Match[str]) -> str:
        nonlocal named, minutes
        word = match[0].lower()
        if word in ("am", "pm"):
            return word[0].upper()
        if word in ("年", "月", "日"):
            return " " if word == "日" else "-"
        if word in _MONTHS and not named:
            named = _MONTHS[word]
            return "M"
        if word in _ZONES:
            minutes = _ZONES[word]
            return "Z"
        return " " if word in _IGNORED else "?"

    shape = _WORD.sub(code, _HALF.sub(r"\1m", bare))
    shape = _NUMBER.sub(lambda match: str(min(len(match[0]), 9)), shape.replace("\xa0", " ").replace("#", " "))
    shape = re.sub(r"[.,]? +(?:[.,] +)*", " ", shape).strip(" ,.")
    match = next(filter(None, (form.fullmatch(shape) for form in _FORMS)), None)
    if match is None:
        return None
    found = match.groupdict()

    def places(name: str) -> tuple[int, ...]:
        if found.get(name) is None:
            return ()
        before = sum(map(str.isdigit, shape[: match.start(name)]))
        return tuple(range(before, before + sum(map(str.isdigit, found[name]))))

    def place(name: str) -> int | None:
        return next(iter(places(name)), None)

    offset = found.get("offset") or ""
    if (bare != cell and not found["zone"] and not offset) or (minutes and offset and found["zone"]):
        return None  # a zone whose offset is not known, as a place is named in its stead or CET+1 may be either
    return _Layout(
        year=place("year"),
        month=place("month") if not named else None,
        day=place("day"),
        nth=place("nth"),
        whole=place("whole"),
        named=named,
        clock=places("clock"),
        half=found["half"],
        minutes=minutes if found["zone"] or not offset else 0,
        sign=-1 if offset.startswith("-") else 1,
        offset=places("offset"),
        either=not named and shape[0] in "12",
        digits=int(found.get("year") or 4),
    )


def layout(cell: str) -> _Layout | None:
    """Return the layout of a date; None if the cell is none."""
    return _layout(cell.translate(_ZEROS))


def is_day(cell: str) -> bool:
    """Return whether a cell is a date without a clock."""
    found = layout(cell)
    return found is not None and not found.clock and (found.whole is None or cell[:2] in ("19", "20"))


def ns_of_date(cell: str, month_first: bool) -> tuple[int, bool] | None:
    """Return a date as ns, and whether it is local time; None if it is no date."""
    found = layout(cell)
    if found is None:
        return None
    numbers = _NUMBER.findall(cell)
    if found.whole is not None:
        whole = numbers[found.whole]
        year, month, day = int(whole[:4]), int(whole[4:6]), int(whole[6:])
    else:
        year = int(numbers[found.year or 0]) + (2000 if found.digits == 2 else 0)
        month = int(numbers[found.month]) if found.month is not None else found.named or 1
        day = int(numbers[found.day]) if found.day is not None else 1
        if found.either and month_first:
            day, month = month, day
    clock = found.clock
    hour, minute, second, fraction = 0, 0, 0, ""
    if clock and len(first := numbers[clock[0]]) > 2:  # 080000 or 0800
        hour, minute, second = int(first[:2]), int(first[2:4]), int(first[4:] or 0)
        fraction = numbers[clock[1]] if len(clock) > 1 else ""
    elif clock:
        hour, minute = int(first), int(numbers[clock[1]])
        second = int(numbers[clock[2]]) if len(clock) > 2 else 0
        fraction = numbers[clock[3]] if len(clock) > 3 else ""
    if found.half is not None:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + (12 if found.half == "P" else 0)
    try:
        days = datetime(year, month, day, hour, minute, second).toordinal() - _EPOCH_DAY
    except ValueError:
        return None
    if found.nth is not None:
        days += int(numbers[found.nth]) - 1
        if not 1 <= int(numbers[found.nth]) <= 365 + isleap(year):
            return None
    t = (((days * 24 + hour) * 60 + minute) * 60 + second) * 10**9
    if fraction:
        t += int(fraction[:9].ljust(9, "0"))
    if found.minutes is None:
        return t, True
    ahead = found.minutes
    if found.offset:
        hours, *rest = (numbers[place] for place in found.offset)
        hours, rest = (hours[:2], [hours[2:]]) if len(hours) == 4 else (hours, rest)
        ahead += found.sign * (int(hours) * 60 + int(rest[0] if rest else 0))
    return t - ahead * 60 * 10**9, False


def since_epoch(when: datetime) -> tuple[int, bool]:
    """Return ns, and whether `when` has no offset."""
    naive = when.tzinfo is None
    delta = when - (_NAIVE_EPOCH if naive else _EPOCH)
    return (delta.days * 86_400 + delta.seconds) * 10**9 + delta.microseconds * 1000, naive


def ns_of_iso(text: str) -> tuple[int, bool] | None:
    """Return an ISO 8601 date as ns, and whether it has no offset."""
    if text[4:5] not in ("-", "W") and not text[:5].isdigit():
        return None  # at a tenth of the time
    head, dot, tail = text.partition(".")
    digits = len(tail) - len(tail.lstrip("0123456789"))
    fraction, offset = tail[:digits], tail[digits:]
    try:
        t, naive = since_epoch(datetime.fromisoformat(head + offset))
    except ValueError:
        return None
    return t + (int(fraction[:9].ljust(9, "0")) if dot and fraction else 0), naive
