"""DBC files, and the messages and signals that channels name."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path
from typing import Any

import cantools

from estimators.errors import SourceError, nearest

from ..source import Channel
from .frames import BusName


def load_database(path: Path) -> Any:
    """Load a database file (DBC, or any other that cantools reads), cached while the file is unchanged.

    Raises:
        SourceError: If it is missing or not a database.
    """
    try:
        stamp = path.stat().st_mtime_ns
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}; check the path of the DBC") from None
    return _load(path, stamp)


@lru_cache(maxsize=16)
def _load(path: Path, stamp: int) -> Any:
    logger = logging.getLogger("cantools")
    level = logger.level
    logger.setLevel(logging.ERROR)  # It warns of duplicate names, which are harmless.
    try:
        # Not strict: signals of DBC files in use overlap, which is harmless where they are not read.
        database = cantools.database.load_file(path, strict=False)
    except (cantools.database.UnsupportedDatabaseFormatError, cantools.database.Error, OSError, ValueError) as error:
        gist = " ".join(str(error).split())[:200]
        raise SourceError(f"{path}: it cannot be read as a DBC ({gist}); check that it is one") from None
    finally:
        logger.setLevel(level)
    if not isinstance(database, cantools.database.can.Database):
        raise SourceError(f"{path}: it describes no CAN messages; give a DBC")
    return database


def same_bus(wanted: BusName, actual: BusName) -> bool:
    """Return whether bus `actual` is the bus `wanted`: None is any, and can0 and 0 are the same bus."""
    if wanted is None or actual is None or wanted == actual or str(wanted) == str(actual):
        return True
    if isinstance(wanted, str) == isinstance(actual, str):
        return False
    number, name = (wanted, str(actual)) if isinstance(wanted, int) else (actual, str(wanted))
    digits = name[len(name.rstrip("0123456789")) :]
    return digits != "" and int(digits) == number


def find_messages(databases: list[tuple[Path, BusName]], channel: Channel) -> tuple[list[Any], BusName, Path]:
    """Return the messages that carry a channel, with bus and path of the first database that has them.

    There are several if a DBC gives one name to messages of different ids (two devices of a kind).

    Raises:
        SourceError: If no database has the message, or it lacks a signal.
    """
    name = channel.message
    if name is None:
        raise SourceError(f"{channel.name}: it names no message; add the message of the DBC that carries it")
    known: list[str] = []
    for path, bus in databases:
        database = load_database(path)
        found = [message for message in database.messages if message.name == name]
        for message in found:
            signals = [signal.name for signal in message.signals]
            for signal in channel.needed:
                if signal not in signals:
                    raise SourceError(
                        f"{path.name}: message {name} has no signal {signal!r}; {nearest(signal, signals)}"
                    )
        if found:
            return found, bus, path
        known += [message.name for message in database.messages]
    files = ", ".join(path.name for path, _ in databases)
    raise SourceError(f"{files}: there is no message {name!r}; {nearest(name, known)}")
