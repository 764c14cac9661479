"""Values of CAN signals that are no measurement: outside the limits of the DBC, or codes such as "not available"."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..source import Report

NO_VALUE = re.compile(
    r"(signal|sensor|value|data)*(sna|snv|na|(not|un)(available|valid|defined)|invalid|no(value|data|signal))"
    r"(value|signal|data)?(or.*)?"
)
"""Names of codes that say that there is no value, in lower case and of letters alone."""

ERROR = re.compile(r"(signal|sensor|value|data)*(err|error|faulty?|failure)(indicator|code|value|signal|state)?(or.*)?")
"""Names of codes of an error; a signal all of whose values are named may have such a state."""

J1939_LENGTHS = (2, 4, 8, 16, 24, 32)


class Limits:
    """Intervals of values that are missing, for each signal of each message.

    Limits of a DBC with max > min hold to half a step of the signal; those that are raw numbers, or beyond what its
    bits can express, were not made for it and are ignored. An unsigned signal of a J1939 message has the codes of SAE
    J1939-71, tables 1 and 2: 0xFE "error" and 0xFF "not available" in its highest byte, or its two highest
    values if it has 2 or 4 bits, unless the DBC names them otherwise.

    Args:
        messages: Messages (cantools), each with its signals in the order of the decoder's columns.
        checked: Names of the signals of each message that are used as values; signals of conditions keep theirs.
        report: Receives each missing value.
    """

    def __init__(
        self, messages: Sequence[tuple[Any, Sequence[Any]]], checked: Sequence[set[str]], report: Report
    ) -> None:
        self._messages, self._report = messages, report
        self._rules = {
            (m, j): list(_rules(message, signal))
            for m, (message, signals) in enumerate(messages)
            for j, signal in enumerate(signals)
            if signal.name in checked[m]
        }
        found = {place: _merged([(low, high) for low, high, _ in rules]) for place, rules in self._rules.items()}
        most = max((len(signals) for _, signals in messages), default=1)
        self._low, self._high = np.full((2, max(map(len, found.values()), default=0), len(messages), most), np.nan)
        for (m, j), intervals in found.items():
            for k, (low, high) in enumerate(intervals):
                self._low[k, m, j], self._high[k, m, j] = low, high

    def apply(self, plan: np.ndarray, values: np.ndarray) -> None:
        """Replace what is no measurement by NaN, and report it.

        Args:
            plan: Message of each frame, (n,).
            values: Physical values, (n, signals of a message).
        """
        if not len(self._low):
            return
        hit = np.zeros(values.shape, np.bool_)
        for low, high in zip(self._low, self._high, strict=True):
            hit |= (values >= low[plan]) & (values <= high[plan])
        for i, j in np.argwhere(hit).tolist():
            message, signals = self._messages[plan[i]]
            value, signal = float(values[i, j]), signals[j]
            why = next(text for low, high, text in reversed(self._rules[int(plan[i]), j]) if low <= value <= high)
            name = f"{message.name}.{signal.name}"
            self._report(f"no value {name}", f"{name} is {value:.7g} {signal.unit or ''}".rstrip() + f", {why}")
        values[hit] = np.nan


def _rules(message: Any, signal: Any) -> Iterator[tuple[float, float, str]]:
    """Yield intervals of missing values of a signal with their reasons; of those that overlap the last one counts."""
    scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
    slack = 0.0 if signal.is_float else 0.5 * abs(scale)

    def interval(first: float, last: float) -> tuple[float, float]:
        low, high = sorted((first * scale + offset, last * scale + offset))
        return low - slack, high + slack

    low, high = signal.minimum, signal.maximum
    if low is not None and high is not None and high > low:
        low, high = float(low), float(high)
        top = 1 << (signal.length - signal.is_signed)
        bits = (-top if signal.is_signed else 0, top - 1)
        least, most = (-np.inf, np.inf) if signal.is_float else interval(*bits)
        if least - slack <= low and high <= most + slack and ((low, high) != bits or (scale, offset) == (1.0, 0.0)):
            text = f"outside {low:g} to {high:g}; the value is missing: correct the limits in the DBC if it is right"
            yield -np.inf, float(np.nextafter(low - slack, -np.inf)), text
            yield float(np.nextafter(high + slack, np.inf)), np.inf, text
    if signal.length < 2:
        return
    names = {int(raw): str(name) for raw, name in (signal.conversion.choices or {}).items()}
    words = {raw: re.sub(r"[^a-z]", "", name.lower()) for raw, name in names.items()}
    codes = {
        raw
        for raw, word in words.items()
        if NO_VALUE.fullmatch(word) or (ERROR.fullmatch(word) and len(names) < 2**signal.length)
    }
    if message.protocol == "j1939" and not (signal.is_signed or signal.is_float) and signal.length in J1939_LENGTHS:
        size = 1 << max(0, signal.length - 8)
        for back, text in ((2, "error"), (1, "not available")):
            first = (1 << signal.length) - back * size
            if all(ERROR.fullmatch(words[raw]) or raw in codes for raw in names if first <= raw < first + size):
                yield *interval(first, first + size - 1), f"reserved for {text!r} by J1939; the value is missing"
    for raw in codes:
        yield *interval(raw, raw), f"code {raw}, {names[raw]!r} in the DBC; the value is missing"


def _merged(intervals: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the union of intervals."""
    found: list[tuple[float, float]] = []
    for low, high in sorted(intervals):
        if found and low <= found[-1][1]:
            low, high = found[-1][0], max(high, found.pop()[1])
        found.append((low, high))
    return found
