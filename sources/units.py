"""Conversion of units, in the spellings that DBC files and people use."""

from __future__ import annotations

import re
from contextlib import suppress
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from estimators.errors import SourceError

if TYPE_CHECKING:
    import pint

_SAME = {
    "%": "percent", "kmh": "km/h", "kph": "km/h", "km/hr": "km/h", "Nm": "N*m", "1/min": "rpm", "U/min": "rpm",
    "r/min": "rpm", "rev/min": "rpm", "min-1": "rpm", "1/s": "Hz", "m/s/s": "m/s**2", "G": "standard_gravity",
    "sec": "s", "Amps": "A", "Ohm": "ohm", "degrees": "deg", "PS": "metric_horsepower", "As": "A*s", "rev": "turn",
    "kmph": "km/h", "centigrade": "degC", "ft-lb": "ft*lbf", "lb-ft": "ft*lbf", "inWC": "inH2O", "psia": "psi",
}  # fmt: skip
"""Spellings with one meaning (1/min on a bus is a rotation)."""

_ANY_CASE = {
    word.lower(): word
    for word in "rpm kph mph kts psi bar atm Hz kHz Pa hPa kPa kg kN kV kA kW kWh km h deg degC degF mmHg inHg".split()
} | {"cfm": "ft**3/min", "gpm": "gal/min", "lpm": "l/min"}
"""Words that mean one thing in capitals, too: K and H are no prefixes of the SI, but M and m are two."""

_REFUSED = (
    (
        re.compile(r"(?i:[NS]m(3|³|\^3|\*\*3)|nlpm|slpm|slm|sccm|scfm|scfh)(\W.*)?|N[lL](/.*)?"),
        "is a volume of gas at normal or standard conditions, which are not known; give a volume or an amount under "
        "`units`, and the factor as `scale`",
    ),
    (
        re.compile(r"(?i:db[ (]*(m|w|v|uv|µv|a|b|spl|i|c|fs|u)?\)?|np)(/.*)?"),
        "is a logarithm, which no factor converts; convert the column first",
    ),
    (
        re.compile(r"(?i:psi|(m|k)?bar|kPa)[ (]*[gG]\)?"),
        "is a pressure above that of the atmosphere, which is not known; if the model's is one too, give the unit "
        "without g under `units`",
    ),
    (re.compile(r"(?i:grad)(\W.*)?"), "may be a degree or a gon; give deg, degC or gon under `units`"),
    (
        re.compile(r"(bbl|mt|tons?|gr|Gs|degs|fc|MBtu)(\W.*)?"),
        "has several meanings; give its full name under `units`, such as oil_barrel, metric_ton, grain or gauss",
    ),
)
"""Spellings that have several meanings, or are no multiple of another unit, and why they are refused."""

FACTORS = 0.999e-9, 1.001e9
"""Range of factors; others are of a spelling that was misunderstood rather than of a measurement."""

_OTHERWISE = {"g": "standard_gravity", "C": "degC", "F": "degF"}
"""Second meaning of a spelling, if the first one (gram, coulomb, farad) has the wrong dimension."""


def _normal(unit: str) -> str:
    """Return one spelling of a unit: ASCII, with ** for powers."""
    text = unit.strip()
    text = re.sub(r"\b[dD]eg(?:ree)?s? ?([CF])\b", r"deg\1", _SAME.get(text, text))
    for old, new in (
        ("Ohm", "ohm"), ("℃", "degC"), ("°C", "degC"), ("°F", "degF"), ("°", "deg"), ("·", "*"), ("²", "**2"),
        ("³", "**3"), ("^", "**"),
    ):  # fmt: skip
        text = text.replace(old, new)
    text = re.sub(r"\b([kmMc]?)N(c?m)\b", r"(\1N*\2)", text)
    return re.sub(r"(?<=[A-Za-z])(?=\d)", "**", text) if "/" in text or text[-1:].isdigit() else text


def _refusal(unit: str) -> str | None:
    """Return why a unit is refused; None if it is not."""
    return next((reason for pattern, reason in _REFUSED if pattern.fullmatch(unit.strip())), None)


def _spellings(normal: str) -> dict[str, None]:
    """Return a normal spelling, and what else it may mean."""
    words = re.sub(r"\b[A-Z][a-z]{2,}\b", lambda match: match[0].lower(), normal)
    cased = re.sub(r"[A-Za-z]+", lambda match: _ANY_CASE.get(match[0].lower(), match[0]), normal)
    return dict.fromkeys((normal, _OTHERWISE.get(normal, normal), cased, words))


@lru_cache(maxsize=1)
def _registry() -> pint.UnitRegistry:
    import pint  # Here, not above: it takes half a second, and most twins use the model's own units.

    return pint.UnitRegistry(cache_folder=None)


def _unit(text: str) -> pint.Unit:
    """Return a unit of pint's; a temperature within a product is a difference of temperatures.

    Raises:
        LookupError: If it is unknown.
    """
    import pint

    if re.search(r"[*/]", text):
        text = re.sub(r"\b(degC|degF)\b", r"delta_\1", text)
    try:
        return _registry().Unit(text)
    except (pint.PintError, ArithmeticError, AttributeError, TypeError, ValueError, SyntaxError, AssertionError):
        raise LookupError(text) from None


def _turns(unit: str) -> bool | None:
    """Return whether a frequency is a rotation (rpm, rad/s) or not (Hz); None for other units."""
    try:
        found = _unit(unit)
    except LookupError:
        return None
    if found.dimensionality != _registry().Unit("Hz").dimensionality:
        return None
    angles = ("radian", "degree", "turn", "revolution", "revolutions_per_minute", "revolutions_per_second")
    return any(name.endswith(angles) for name in dict(_registry().Quantity(1.0, found).unit_items()))


def _refuse_turns(a: str, b: str, given: str, wanted: str, where: str) -> None:
    """Refuse to make a rotation of a frequency, or the reverse: an angle has no unit, so it would be off by 2π.

    Raises:
        SourceError: Beginning with `where`.
    """
    source, target = _turns(a), _turns(b)
    if source is None or target is None or source == target:
        return
    raise SourceError(
        f"{where}: {given!r} is {'a rotation' if source else 'a frequency'} and the model's {wanted!r} is not, so they "
        f"may differ by 2π; give {'Hz' if source else 'rad/s'} under `units`, and the factor as `scale`"
    )


@lru_cache(maxsize=256)
def conversion(given: str | None, wanted: str, where: str) -> tuple[float, float]:
    """Factor and offset that turn a value in `given` into one in `wanted`: factor * value + offset.

    A unit that is None or empty is taken to be the other.

    Raises:
        SourceError: Beginning with `where`, if they measure different things or one is unknown.
    """
    if not given or not given.strip() or not wanted.strip():
        return 1.0, 0.0
    a, b = _normal(given), _normal(wanted)
    if a == b:
        return 1.0, 0.0
    if reason := _refusal(given):
        raise SourceError(f"{where}: {given!r} {reason}")
    import pint

    _refuse_turns(a, b, given, wanted, where)
    remedy = "declare its `units`" if a in ("", "-") else "write one that converts, under `units`"
    try:
        target = _unit(b)
    except LookupError:
        raise SourceError(
            f"{where}: the model's unit {wanted!r} is unknown, and {given!r} is not it; {remedy}"
        ) from None
    for text in _spellings(a):
        try:
            source = _unit(text)
            at_zero = float(_registry().Quantity(0.0, source).to(target).magnitude)
            if at_zero == 0.0:
                factor = float(_registry().Quantity(1.0, source).to(target).magnitude)
            else:
                at_thousand = float(_registry().Quantity(1000.0, source).to(target).magnitude)
                factor = round((at_thousand - at_zero) / 1000.0, 12)
        except (LookupError, pint.PintError):
            continue
        if not FACTORS[0] <= abs(factor) <= FACTORS[1]:
            raise SourceError(
                f"{where}: {given!r} is {factor:.3g} of the model's {wanted!r}, which is hardly meant; if it is, give "
                f"{wanted} under `units`, and the factor as `scale`"
            )
        return factor, at_zero
    try:
        _unit(a)
    except LookupError:
        raise SourceError(f"{where}: unit {given!r} is unknown, and the model's is {wanted!r}; {remedy}") from None
    raise SourceError(f"{where}: {given!r} does not convert to the model's {wanted!r}; {remedy}")


def declared_conversion(declared: str | None, found: str | None, wanted: str, where: str) -> tuple[float, float]:
    """Return `conversion` from the unit that the YAML declares, otherwise from the one found in the file.

    Raises:
        SourceError: As `conversion`, and if the YAML declares a unit with a dimension where the model has none.
    """
    if declared and declared.strip() and not wanted.strip() and _has_dimension(_normal(declared)):
        raise SourceError(
            f"{where}: the model's quantity has no unit, so {declared!r} under `units` has no effect; "
            "write the unit in the model, or the factor as `scale`"
        )
    return conversion(declared or found, wanted, where)


def _has_dimension(unit: str) -> bool:
    try:
        return not _unit(_OTHERWISE.get(unit, unit)).dimensionless
    except LookupError:
        return unit not in ("", "-")


_HEADING = re.compile(r".+?\s*[\[(]([^\[\](),]+)[\])]\s*")
_COMMA = re.compile(r".+, *([^,()\[\]]+?) *(?:\([^()]*\))?")  # Temp, °C (LGR S/N: 2012, SEN S/N: 2013)

_ELEMENT = re.compile(r"/\S+\.\S+\[[^\[\]]+\]")
"""Element of a field of a ROS topic, whose name is no unit: /joint_states.position[arm]."""


def heading_unit(name: object) -> str | None:
    """Return the unit in a heading, such as `Level [mm]`, `Level (mm)` or `Level, mm`; None if it has no known one."""
    if not isinstance(name, str) or _ELEMENT.fullmatch(name):
        return None
    for match in filter(None, (form.fullmatch(name) for form in (_HEADING, _COMMA))):
        if re.search(r"[A-Za-z°%]", text := match[1].strip()) and _is_known(text):
            return text
    return None


def unknown_unit(name: str) -> bool:
    """Return whether the heading of a column ends with a word in brackets that is no known unit."""
    match = _HEADING.fullmatch(name)
    return match is not None and bool(re.fullmatch(r"[^\W\d]\S*", match[1])) and heading_unit(name) is None


def _is_known(text: str) -> bool:
    """Return whether a text is a unit, or one that is refused."""
    for spelling in _spellings(_normal(text)):
        with suppress(LookupError):
            _unit(spelling)
            return True
    return _refusal(text) is not None


_SUFFIXES = {
    "mps": "m/s", "kmh": "km/h", "kph": "km/h", "mph": "mph", "rpm": "rpm", "rad": "rad", "deg": "deg", "degC": "degC",
    "degF": "degF", "kPa": "kPa", "hPa": "hPa", "mbar": "mbar", "bar": "bar", "psi": "psi", "mV": "mV", "mA": "mA",
    "kW": "kW", "Hz": "Hz", "mm": "mm", "cm": "cm", "km": "km", "m": "m",
}  # fmt: skip
"""Units by the last word of a heading, such as speed_kmh."""


def suffix_unit(name: str) -> str:
    """Return the unit in the last word of a heading, such as `speed_kmh`; empty if there is none."""
    word = name.rpartition("_")[2] if "_" in name else ""
    return _SUFFIXES.get(word) or next((unit for key, unit in _SUFFIXES.items() if key.lower() == word.lower()), "")


def unit_scale(given: str, wanted: str) -> float | None:
    """Return the factor from one unit to another; None if one is not known, or they measure different things."""
    if not given.strip() or not wanted.strip():
        return None
    try:
        return conversion(given, wanted, "")[0]
    except SourceError:
        return None


def spread_factor(given: str | None, wanted: str, where: str, *, squared: bool) -> float:
    """Return the factor from a standard deviation, or a variance if `squared`, in `given` to one in `wanted`.

    A spread has no offset: one of 2 °C is 2 K.

    Raises:
        SourceError: As `conversion`.
    """
    if squared and wanted.strip():
        wanted = f"({_normal(wanted)})**2"
    return conversion(given, wanted, where)[0]


def to_ns(seconds: float | np.ndarray) -> np.ndarray:
    """Return float seconds as int64 nanoseconds.

    A float of today's epoch seconds has steps of 238 ns. Loggers write microseconds, which such a float can
    distinguish: where a microsecond reads back as this very float, it is taken. Elsewhere the float's own
    value is taken, exact to the nanosecond, where `seconds * 1e9` would round to steps of 256 ns.
    """
    seconds = np.asarray(seconds, np.float64)
    micros = np.round(seconds * 1e6)
    whole = np.floor(seconds)
    exact = whole.astype(np.int64) * 1_000_000_000 + np.round((seconds - whole) * 1e9).astype(np.int64)
    # Below 2^23 s a float resolves a nanosecond by itself.
    coarse = np.abs(seconds) >= 2.0**23
    return np.where(coarse & (micros / 1e6 == seconds), micros.astype(np.int64) * 1000, exact)


def second_ns(seconds: float) -> int:
    """Return `to_ns` of one number, without arrays: for frames as they arrive."""
    micros = round(seconds * 1e6)
    if abs(seconds) >= 2.0**23 and micros / 1e6 == seconds:
        return micros * 1000
    whole = int(seconds // 1)
    return whole * 1_000_000_000 + round((seconds - whole) * 1e9)
