"""A source whose events pass through faults; it is held, hurried and sought as the one inside."""

from __future__ import annotations

from estimators.log import Events

from ..source import Endless, Paced, Source, span_of
from .layer import Faults


class FaultySource:
    """Gives what `inner` gives, as `faults` make it.

    Around a replay it stands outside the pacer, so that a fault that is injected holds for what is played next, not
    only for what has not been read ahead.
    """

    def __init__(self, inner: Source, faults: Faults) -> None:
        self._inner = inner
        self._paced = inner if isinstance(inner, Paced) else None
        self._restarts = self._paced.restarts if self._paced is not None else 0
        self.faults = faults
        self.live = inner.live

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time of the source inside, ns; None if it does not tell."""
        return span_of(self._inner)

    @property
    def endless(self) -> bool:
        """Whether the source inside has no end."""
        return isinstance(self._inner, Endless) and self._inner.endless

    def read(self, timeout: float) -> Events | None:
        """The next events, and those that were kept back until now; None at the end."""
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
        # All that arrived until `now` has been given.
        return self.faults.release(now)

    def now(self) -> int | None:
        """The present time of the source inside, ns."""
        return self._inner.now()

    def close(self) -> None:
        """Close the source inside."""
        self._inner.close()


class PacedFaultySource:
    """The same around a source whose time can be held and sought. Begun again by seeking back, so are its faults."""

    live = False

    def __init__(self, inner: Paced, faults: Faults) -> None:
        self._inner = inner
        self._faulty = FaultySource(inner, faults)
        self.faults = faults

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns; None if it does not tell."""
        return self._inner.span

    @property
    def speed(self) -> float:
        """Times real time."""
        return self._inner.speed

    @property
    def paused(self) -> bool:
        """Whether it is held."""
        return self._inner.paused

    @property
    def restarts(self) -> int:
        """How often it was begun again."""
        return self._inner.restarts

    def read(self, timeout: float) -> Events | None:
        """The events that are due, and those that were kept back until now; None at the end."""
        return self._faulty.read(timeout)

    def now(self) -> int | None:
        """Where it stands, ns."""
        return self._inner.now()

    def close(self) -> None:
        """Close the source inside."""
        self._inner.close()

    def pause(self) -> None:
        """Hold its time."""
        self._inner.pause()

    def resume(self) -> None:
        """Let it go on."""
        self._inner.resume()

    def set_speed(self, speed: float) -> None:
        """Go on at `speed` times real time."""
        self._inner.set_speed(speed)

    def step(self) -> None:
        """Release the events of the next time at which there are any."""
        self._inner.step()

    def seek(self, t: int) -> None:
        """Move to t, ns."""
        self._inner.seek(t)


def with_faults(source: Source, faults: Faults) -> FaultySource | PacedFaultySource:
    """The source behind these faults."""
    return PacedFaultySource(source, faults) if isinstance(source, Paced) else FaultySource(source, faults)
