"""A source behind a layer of faults, with the controls of the source inside."""

from __future__ import annotations

from estimators.log import Events

from ..source import Endless, Paced, Source, span_of
from .layer import Faults


class FaultySource:
    """Source of the events of `inner` under `faults`.

    It stands outside the pacer of a replay, so that an injected fault affects the next events to be played, including
    those that were read ahead.
    """

    def __init__(self, inner: Source, faults: Faults) -> None:
        self._inner = inner
        self._paced = inner if isinstance(inner, Paced) else None
        self._restarts = self._paced.restarts if self._paced is not None else 0
        self.faults = faults
        self.live = inner.live

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time of the source inside, ns; None if it is not known."""
        return span_of(self._inner)

    @property
    def endless(self) -> bool:
        """Whether the source inside has no end."""
        return isinstance(self._inner, Endless) and self._inner.endless

    def read(self, timeout: float) -> Events | None:
        """Return the next events and the delayed ones that are due; None at the end."""
        now = self._inner.now()
        batch = self._inner.read(timeout)
        if self._paced is not None and self._paced.restarts != self._restarts:
            self._restarts = self._paced.restarts
            self.faults.restart()
        if batch is None:
            rest = self.faults.finish()
            return rest if len(rest) else None
        if len(batch) or now is None:
            return self.faults.pass_on(batch)
        # All events that arrived until `now` have been returned.
        return self.faults.release(now)

    def now(self) -> int | None:
        """Return the present time of the source inside, ns."""
        return self._inner.now()

    def close(self) -> None:
        """Close the source inside."""
        self._inner.close()


class PacedFaultySource(FaultySource):
    """The same with the controls of a paced source. When it begins again by seeking back, so do its faults."""

    _inner: Paced

    @property
    def speed(self) -> float:
        """Speed, times real time."""
        return self._inner.speed

    @property
    def paused(self) -> bool:
        """Whether it is paused."""
        return self._inner.paused

    @property
    def restarts(self) -> int:
        """How often it began again by seeking back."""
        return self._inner.restarts

    def pause(self) -> None:
        """Pause."""
        self._inner.pause()

    def resume(self) -> None:
        """Resume."""
        self._inner.resume()

    def set_speed(self, speed: float) -> None:
        """Continue at `speed` times real time."""
        self._inner.set_speed(speed)

    def step(self) -> None:
        """Release the events of the next time at which there are any."""
        self._inner.step()

    def seek(self, t: int) -> None:
        """Move to t, ns."""
        self._inner.seek(t)


def with_faults(source: Source, faults: Faults) -> FaultySource | PacedFaultySource:
    """Return the source behind these faults."""
    return PacedFaultySource(source, faults) if isinstance(source, Paced) else FaultySource(source, faults)
