"""Values of CAN signals that are no measurement: outside the limits of the DBC, or codes such as "not available"."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from cantools.database.can import Message, Signal

from ..source import Channel, Report

NO_VALUE = re.compile(
    r"(signal|sensor|value|data)*(sna|snv|na|(not|un)(available|valid|defined)|invalid|no(value|data|signal))"
    r"(value|signal|data)?(or.*)?"
)
ERROR = re.compile(r"(signal|sensor|value|data)*(err|error|faulty?|failure)(indicator|code|value|signal|state)?(or.*)?")
"""Names of codes for a missing value and for an error, in lower case, letters only. A signal may have an error as a
state if all of its values are named."""


class SignalLimits:
    """Intervals of values that are missing, for each signal of each message.

    Limits of a DBC with max > min hold to half a step of the signal; those that are raw numbers, or beyond what its
    bits can express, were not made for it and are ignored. An unsigned signal of a J1939 message has the codes of SAE
    J1939-71, tables 1 and 2: 0xFE "error" and 0xFF "not available" in its highest byte, or its two highest values if it
    has 2 or 4 bits, unless the DBC names them otherwise.

    `plans` are messages (cantools) with their signals in the order of the decoder's columns, and `channels` what they
    feed; signals of conditions keep their values. `report` receives each missing value.
    """

    def __init__(
        self, plans: list[tuple[Message, list[Signal]]], channels: list[list[Channel]], report: Report
    ) -> None:
        self._messages, self._report = plans, report
        self._rules = [
            [list(_rules(message, one)) if any(one.name in c.measured for c in own) else [] for one in signals]
            for (message, signals), own in zip(plans, channels, strict=True)
        ]
        shape = (max((len(one) for own in self._rules for one in own), default=0), len(plans))
        self._ends = np.full((2, *shape, max(map(len, self._rules), default=1)), np.nan)
        for m, own in enumerate(self._rules):
            for j, rules in enumerate(own):
                for k, rule in enumerate(rules):
                    self._ends[:, k, m, j] = rule[:2]

    def apply(self, plan: np.ndarray, values: np.ndarray) -> None:
        """Replace what is no measurement in `values` (n, signals of a message) by NaN; `plan` (n,) is the message."""
        which = np.full(values.shape, -1)
        for k, (low, high) in enumerate(zip(*self._ends, strict=True)):
            which[(values >= low[plan]) & (values <= high[plan])] = k
        for i, j in np.argwhere(which >= 0).tolist():
            message, signals = self._messages[plan[i]]
            name = f"{message.name}.{signals[j].name}"
            shown = f"{values[i, j]:.7g} {signals[j].unit or ''}".rstrip()
            self._report(f"no value {name}", f"{name} is {shown}, {self._rules[plan[i]][j][which[i, j]][2]}")
            values[i, j] = np.nan


def span_of(signal: Signal) -> tuple[float, float, bool]:
    """Return the lowest and highest value of a signal (cantools), and whether these are by the limits of the DBC.

    Otherwise they are those that its bits can express.
    """
    scale, offset, bits = float(signal.conversion.scale), float(signal.conversion.offset), signal.length
    low, high = float(signal.minimum or 0.0), float(signal.maximum or 0.0)
    first = -(1 << bits - 1) if signal.is_signed else 0
    raw = first, first + (1 << bits) - 1
    least, most = (-np.inf, np.inf) if signal.is_float else sorted(scale * end + offset for end in raw)
    placeholder = (low, high) == raw != (least, most)
    if least - abs(scale) <= low < high <= most + abs(scale) and not placeholder:
        return max(low, least), min(high, most), True
    return least, most, False


def _rules(message: Message, signal: Signal) -> Iterator[tuple[float, float, str]]:
    """Yield intervals of missing values of a signal with their reasons; of those that overlap the last one counts."""
    scale, offset, bits = float(signal.conversion.scale), float(signal.conversion.offset), signal.length
    slack = 0.0 if signal.is_float else 0.5 * abs(scale)

    def interval(first: float, last: float) -> tuple[float, float]:
        low, high = sorted((first * scale + offset, last * scale + offset))
        return low - slack, high + slack

    low, high, declared = span_of(signal)
    if declared:
        text = f"outside {low:g} to {high:g}; the value is missing: correct the limits in the DBC if it is right"
        yield -np.inf, float(np.nextafter(low - slack, -np.inf)), text
        yield float(np.nextafter(high + slack, np.inf)), np.inf, text
    names = {int(code): str(name) for code, name in (signal.conversion.choices or {}).items()} if bits > 1 else {}
    words = {code: re.sub(r"[^a-z]", "", name.lower()) for code, name in names.items()}
    errors = {code for code, word in words.items() if ERROR.fullmatch(word)}
    codes = {code for code, word in words.items() if NO_VALUE.fullmatch(word)}
    if message.protocol == "j1939" and not (signal.is_signed or signal.is_float) and bits in (2, 4, 8, 16, 24, 32):
        size = 1 << max(0, bits - 8)
        for back, text in ((2, "error"), (1, "not available")):
            first = (1 << bits) - back * size
            if all(code in errors | codes for code in names if first <= code < first + size):
                yield *interval(first, first + size - 1), f"reserved for {text!r} by J1939; the value is missing"
    for code in codes | (errors if len(names) < 2**bits else set()):
        yield *interval(code, code), f"code {code}, {names[code]!r} in the DBC; the value is missing"
