"""Seconds to nanoseconds, without the noise that float seconds since 1970 carry."""

from __future__ import annotations

from typing import Any

import numpy as np


def to_ns(seconds: Any) -> np.ndarray:
    """Float seconds as int64 nanoseconds.

    A float of today's epoch seconds has steps of 238 ns. Loggers write microseconds, which such a float can tell
    apart: where one microsecond reads back as this very float, that microsecond is meant. Elsewhere the float's own
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
    """`to_ns` of one number, without arrays: for frames as they arrive."""
    micros = round(seconds * 1e6)
    if abs(seconds) >= 2.0**23 and micros / 1e6 == seconds:
        return micros * 1000
    whole = int(seconds // 1)
    return whole * 1_000_000_000 + round((seconds - whole) * 1e9)
