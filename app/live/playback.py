"""Pause, step, speed and seek, for sources that can be asked later; a bus cannot."""

from __future__ import annotations

import math
from typing import Any

from estimators.errors import ConfigError
from sources.source import Paced, Source, span_of

from . import commands

LONGEST = 1e9
"""Seconds that a seek may go, 32 years; times are int64 nanoseconds."""

FASTEST = 1e9
"""Times real time; faster is as fast as possible, which is said as infinity."""

PLAYBACK = (commands.Pause, commands.Speed, commands.Step, commands.Seek)


def check_playback(command: Any) -> None:
    """Refuse a speed or a place that cannot be.

    Raises:
        ConfigError: If the speed is not positive or too large, or the place too far.
    """
    if isinstance(command, commands.Speed) and not (0.0 < command.factor <= FASTEST or command.factor == math.inf):
        raise ConfigError(
            f"Speed: factor is {command.factor:g}; it must be positive and at most {FASTEST:g}, or inf for as fast as "
            "possible"
        )
    if isinstance(command, commands.Seek) and not abs(command.seconds) <= LONGEST:
        raise ConfigError(f"Seek: seconds is {command.seconds:g}; it must lie within {LONGEST:g} s")


def playback_status(source: Source) -> dict[str, Any]:
    """What a panel shows of it: paused, speed, seekable, span (ns)."""
    paced = source if isinstance(source, Paced) else None
    return {
        "paused": paced is not None and paced.paused,
        "speed": paced.speed if paced is not None else None,
        "seekable": paced is not None,
        "span": span_of(source),
    }


def play(source: Source, command: Any, first: int) -> None:
    """Carry one of `PLAYBACK` out; `first` is the time of the first event, ns.

    Raises:
        ConfigError: If the source cannot be paused or sought, or as `check_playback`.
    """
    check_playback(command)
    if not isinstance(source, Paced):
        raise ConfigError("a live source cannot be paused, stepped or sought; only a replay or a simulation can")
    if isinstance(command, commands.Pause):
        source.pause() if command.paused else source.resume()
    elif isinstance(command, commands.Speed):
        source.set_speed(command.factor)
    elif isinstance(command, commands.Step):
        source.step()
    else:
        span = source.span
        source.seek((span[0] if span else first) + round(command.seconds * 1e9))
