"""`nisus bus`: simulate the asset of a twin on a CAN bus."""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from app.cli.options import overrides_of
from app.result import to_json
from app.terminal import complain, until_asked_to_end
from app.twin.sources.can import make_player
from app.twin.twin import Twin, load_twin
from estimators.errors import ConfigError

from .arguments import BusCommand

GROUP = "239.74.163.2"  # python-can's own multicast address

FORMATS = (".asc", ".blf", ".csv", ".log", ".mf4", ".trc")
"""What python-can writes and `nisus fold --log` reads; not .db, whose writer forgets what is queued when it stops."""


def play_bus(arguments: BusCommand) -> int:
    """Simulate the asset of a twin on a CAN bus."""
    if arguments.duration is not None and not arguments.duration > 0:
        raise ConfigError(f"--duration {arguments.duration:g}: must be positive")
    twin = load_twin(arguments.twin, overrides=overrides_of(arguments))
    if arguments.interface == "virtual" and arguments.record is None:
        raise ConfigError("--interface virtual: its frames stay in this process; use udp_multicast, or give --record")
    channel = _channel(arguments, twin)
    counts: Counter[str] = Counter()

    def report(key: str, text: str) -> None:
        counts[key] += 1
        if counts[key] == 1:
            complain(text)

    player = make_player(twin.loaded, twin.model, report, interface=arguments.interface, channel=channel)[1]
    logger = None
    try:
        if arguments.record is not None:
            logger = _logger(arguments.record)
            player.listeners.append(logger)
        out = sys.stderr if arguments.json else sys.stdout
        started = f"Nisus plays the asset of {twin.name} on {arguments.interface} {channel}; Ctrl-C ends it."
        print(started, file=out, flush=True)
        if arguments.interface != "virtual":
            print(
                f"To listen: nisus run {arguments.twin} --set source.interface={arguments.interface} "
                f"--set source.channel={channel}",
                file=out,
                flush=True,
            )
        _play(player, arguments.duration)
    finally:
        player.close()
        if logger is not None:
            logger.stop()
    if arguments.json:
        print(to_json({"twin": twin.name, "frames": player.sent, "counts": counts}))
    else:
        print(", ".join([f"{player.sent} frames sent", *(f"{key} {count}" for key, count in counts.items())]))
    return 0


def _channel(arguments: BusCommand, twin: Twin) -> str | int:
    """The channel that was given; else the twin's where it is of this interface, else the interface's own."""
    if arguments.channel is not None:
        return int(arguments.channel) if arguments.channel.isdecimal() else arguments.channel
    source: Any = twin.config.source
    if getattr(source, "interface", None) == arguments.interface:
        return source.channel
    if arguments.interface == "udp_multicast":
        return GROUP
    if arguments.interface == "virtual":
        return "nisus"
    raise ConfigError(f"--interface {arguments.interface}: needs a channel; give --channel, for example can0")


def _logger(path: Path) -> Any:
    """Return a writer for the format that the file's ending names."""
    from sources.can import log_writer

    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--record {path}: there is no folder {path.parent}; create it first")
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"--record {path}: is not a CAN log format; end it in {', '.join(FORMATS)}")
    return log_writer(path)


def _play(player: Any, duration: float | None) -> None:
    """Send frames until the asset ends, the time is up, or a signal arrives."""
    end = time.monotonic() + duration if duration is not None else float("inf")
    with until_asked_to_end() as done:
        player.start()
        while not player.finished and (left := end - time.monotonic()) > 0 and not done.wait(min(0.2, left)):
            pass
