"""Pause, step, speed and seek, for sources that can be asked later; a bus cannot."""

from __future__ import annotations

from typing import Any

from estimators.errors import ConfigError

from . import commands

LONGEST = 1e9
"""Seconds that a seek may go, 32 years; times are int64 nanoseconds."""

PLAYBACK = (commands.Pause, commands.Speed, commands.Step, commands.Seek)


def playback_status(source: Any) -> dict[str, Any]:
    """What a panel shows of it: paused, speed, seekable, span (ns)."""
    return {
        "paused": bool(getattr(source, "paused", False)),
        "speed": getattr(source, "speed", None),
        "seekable": hasattr(source, "seek"),
        "span": getattr(source, "span", None),
    }


def play(source: Any, command: Any, first: int) -> None:
    """Carry one of `PLAYBACK` out; `first` is the time of the first event, ns.

    Raises:
        ConfigError: If the source cannot be paused or sought, or a speed is not positive.
    """
    if not hasattr(source, "seek"):
        raise ConfigError("a live source cannot be paused, stepped or sought; only a replay or a simulation can")
    if isinstance(command, commands.Pause):
        source.pause() if command.paused else source.resume()
    elif isinstance(command, commands.Speed):
        if not command.factor > 0:
            raise ConfigError(f"speed is {command.factor:g}; it must be positive, or inf for as fast as possible")
        source.set_speed(command.factor)
    elif isinstance(command, commands.Step):
        source.step()
    else:
        if not abs(command.seconds) <= LONGEST:
            raise ConfigError(f"seek is {command.seconds:g} s; it must lie within {LONGEST:g} s")
        span = getattr(source, "span", None)
        source.seek((span[0] if span else first) + round(command.seconds * 1e9))
