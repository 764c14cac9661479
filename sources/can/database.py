"""Database files: DBC, and any other that cantools reads."""

from __future__ import annotations

import logging
import re
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import cantools
from cantools.database.can import Database

from estimators.errors import SourceError

from ..worker_process import gist
from .ids import NULL_ADDRESS

USUAL = re.compile(rb"[\xa1-\xa3\xb0-\xd7][\xa1-\xfe]")
"""Usual characters of GB18030: the signs and the first level of GB2312."""

MIN_USUAL = 0.5  # Share of usual ones among those beyond ASCII from which on a DBC is in Chinese


def load_database(path: Path) -> Database:
    """Load a database file (DBC, or any other that cantools reads), cached while the file is unchanged.

    Raises:
        SourceError: If it is missing or not a database.
    """
    try:
        stamp = path.stat().st_mtime_ns
    except OSError as error:
        raise SourceError(f"{path}: {gist(error)}; check the path of the DBC") from None
    return _load(path, stamp)


@lru_cache(maxsize=16)
def _load(path: Path, stamp: int) -> Database:
    logging.getLogger("cantools").setLevel(logging.ERROR)  # It warns of duplicate names, which are harmless.
    try:
        # Not strict: signals of DBC files in use overlap, which is harmless where they are not read.
        encoding = encoding_of(path.read_bytes()) if path.suffix.lower() == ".dbc" else None
        database = cantools.database.load_file(path, encoding=encoding, strict=False)
    except (cantools.database.UnsupportedDatabaseFormatError, cantools.database.Error, OSError, ValueError) as error:
        raise SourceError(f"{path}: it cannot be read as a DBC ({gist(error)}); check that it is one") from None
    if not isinstance(database, Database):
        raise SourceError(f"{path}: it describes no CAN messages; give a DBC")
    protocol = database.dbc.attributes.get("ProtocolType") if database.dbc is not None else None
    formats = database.dbc is not None and "VFrameFormat" in database.dbc.attribute_definitions
    extended = [message for message in database.messages if message.is_extended_frame]
    # By their form, ids are those of J1939 if their source is the null address, which is never that of a frame.
    if (protocol is not None and protocol.value == "J1939" and not formats) or all(
        message.frame_id & 0xFF == NULL_ADDRESS for message in extended
    ):
        for message in extended:
            message.protocol = "j1939"
    return database


def encoding_of(content: bytes) -> str:
    """Return the encoding of a DBC: UTF-8, GB18030 (which contains GB2312), or Windows-1252.

    In a text of Windows-1252, such as `°C` or `Größe`, two bytes beyond ASCII are rarely a usual Chinese character.
    """
    with suppress(UnicodeDecodeError):
        content.decode("utf-8-sig")
        return "utf-8-sig"
    with suppress(UnicodeDecodeError):
        signs = [sign.encode("gb18030") for sign in content.decode("gb18030") if sign > "\x7f"]
        if sum(USUAL.fullmatch(sign) is not None for sign in signs) >= MIN_USUAL * len(signs):
            return "gb18030"
    return "cp1252"
