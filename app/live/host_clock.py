"""The clock of a live source against this machine's: how far off, how fast it drifts, and when that matters."""

from __future__ import annotations

import math

from estimators.diagnostics.clock_fit import ClockFit, LeastDelays
from estimators.log import INPUT, READING, Events

from .notices import Notices

FAST = 200.0
"""Parts per million beyond which a drift is told; a crystal stays within 100."""


PERIOD = 2 * 10**9
"""Nanoseconds of arrival between two fits, which take a millisecond."""


class HostClock:
    """Follows t - arrival of what was let in; a clock that was found to be set has been corrected there."""

    def __init__(self, notices: Notices, horizon: float) -> None:
        """`horizon`: seconds of lateness allowed, beyond which an offset is told."""
        self._notices, self._horizon = notices, horizon
        self._delays = LeastDelays()
        self._due = 0
        self._told: set[str] = set()
        self.estimate: ClockFit | None = None

    def note(self, events: Events) -> None:
        """These have come."""
        stamped = (events.kind == READING) | (events.kind == INPUT)
        if not stamped.any():
            return
        arrival = events.arrival[stamped]
        self._delays.note(events.t[stamped], arrival)
        if abs(int(arrival[-1]) - self._due) >= PERIOD:
            self._due = int(arrival[-1])
            self.estimate = self._delays.fit()
            self._look(self.estimate)

    def _look(self, fit: ClockFit | None) -> None:
        if fit is None or math.isnan(fit.drift_ppm):
            return
        if "offset" not in self._told and abs(fit.offset) > max(1.0, self._horizon):
            self._told.add("offset")
            side = "ahead of" if fit.offset > 0 else "behind"
            self._notices.say(
                f"the source's clock is {abs(fit.offset):.6g} s {side} this machine's, or its readings take that long; "
                "times shown are the source's",
                level="warn",
            )
        if "drift" not in self._told and abs(fit.drift_ppm) - fit.drift_error_ppm > FAST:
            self._told.add("drift")
            self._notices.say(
                f"the source's clock drifts by {fit.drift_ppm:+.0f} ± {fit.drift_error_ppm:.0f} ppm against this "
                "machine's; synchronise them",
                level="warn",
            )


def clock_text(fit: ClockFit) -> str:
    """Offset and drift in a few words; what rounds to zero is not negative."""
    offset = f"{fit.offset:+z.3f} s"
    if math.isnan(fit.drift_ppm):
        return offset
    return f"{offset}, {fit.drift_ppm:+z.1f} ± {fit.drift_error_ppm:.1g} ppm"
