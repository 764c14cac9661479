"""Download of a recording from its source, or copy of the user's files, and conversion.

Files of the source stay in `RecordingSet.parts` until all are there, so that a download that was cut off goes on where
it ended. Only files with the SHA-256 of sets.yaml are used.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pooch
import requests

from app.record.rrd_file import Disk
from estimators.errors import ConfigError, SourceError
from sources.worker_process import gist

from . import convert
from .sets import RecordingSet, SourceFile, size_text

RETRIES = 3
"""Further attempts at a file, after 1, 2 and 3 s."""

TIMEOUT_S = 30.0
"""Longest silence of a server."""

PIECE_BYTES = 2**12
"""Size of the pieces of a file, the last of which is lost where a download is cut off."""

REMEDIES = {
    errno.ENOSPC: "free some space and try again: the download goes on where it ended",
    errno.ENOENT: "check the path",
    errno.EROFS: "set NISUS_DATA to a folder that can be written",
    errno.EACCES: "set NISUS_DATA to a folder that can be written",
}

pooch.get_logger().setLevel(logging.WARNING)  # its own lines of progress


def get(recording: RecordingSet, given: Sequence[Path] = ()) -> None:
    """Put the files of a recording that are missing into its folder; `given` are files that are read, not downloaded.

    Raises:
        ConfigError: If it is not downloaded, and no files are given.
        SourceError: If the source or a file fails, or the disk is full; a partial download is kept.
    """
    if not recording.lacking:
        return
    if recording.by_hand and not given:
        raise ConfigError(f"{recording.name}: {recording.by_hand}")
    folder, parts = recording.folder, recording.parts
    try:
        parts.mkdir(parents=True, exist_ok=True)
        needed = 2 * recording.bytes  # converted files are not larger than those of the source
        if (free := Disk(parts).free()) < needed:
            left = f"has room for {size_text(max(free, 0))}, and {recording.name} takes {size_text(needed)}"
            raise SourceError(f"the disk of {folder.parent} {left}; free some, or set NISUS_DATA to a folder elsewhere")
        if given and recording.table is not None and given[0].suffix.lower() == ".csv":
            getattr(convert, recording.table)(recording, given[0])
        else:
            _copy(recording, given) if given else _download(recording)
            if recording.convert is not None:
                getattr(convert, recording.convert)(recording)
        for name in recording.lacking:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(parts / name, folder / name)
        shutil.rmtree(parts)
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "try again")
        raise SourceError(f"{error.filename or folder.parent}: {gist(error)}; {remedy}") from None


def _download(recording: RecordingSet) -> None:
    """Download the files of the source that are not there yet."""
    hashes = {file.to: f"sha256:{file.sha256}" for file in recording.files}
    urls = {file.to: file.url for file in recording.files}
    source = pooch.create(recording.parts, base_url="", registry=hashes, urls=urls, retry_if_failed=RETRIES)
    for file in recording.files:
        try:
            source.fetch(file.to, downloader=partial(_resume, file, recording.parts / f"{file.to}.part"))
        except (requests.RequestException, ValueError) as error:
            reason: BaseException = error
            while reason.args and isinstance(reason.args[0], Exception):  # the innermost is the reason
                reason = getattr(reason.args[0], "reason", None) or reason.args[0]
            text = re.sub(r"^\w+\(.*?\): | for url: .*", "", str(reason.args[0] if reason.args else reason))
            if not isinstance(error, requests.RequestException):
                text = f"its SHA-256 is not {file.sha256[:12]}…, so it was not kept"
            remedy = f"download it by hand: nisus data get {recording.twins[0]} --file FILE..."
            raise SourceError(f"{file.url}: {text}; try again to continue the download, or {remedy}") from None


def _resume(file: SourceFile, part: Path, url: str, output: str, _: Any) -> None:
    """Download a file for pooch, from the byte at which the last attempt ended."""
    with part.open("ab", buffering=0) as arrived:
        if arrived.tell() > file.bytes:
            arrived.seek(0)
            arrived.truncate()
        if (begin := arrived.tell()) < file.bytes:
            headers = {"Accept-Encoding": "identity", "Range": f"bytes={begin}-"}
            with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT_S) as answer:
                answer.raise_for_status()
                if answer.status_code != requests.codes.partial_content:
                    arrived.truncate(0)  # a server that knows no ranges sends all of it
                for piece in answer.iter_content(PIECE_BYTES):
                    arrived.write(piece)
                    if arrived.tell() > file.bytes:
                        break
        size = arrived.tell()
    if size < file.bytes:
        raise requests.ConnectionError(f"the connection ended after {size_text(size)} of {size_text(file.bytes)}")
    os.replace(part, output)


def _copy(recording: RecordingSet, given: Sequence[Path]) -> None:
    """Copy the files of the source from those of the user, which are known by their SHA-256."""
    found = {}
    for path in given:
        with path.open("rb") as content:
            found[hashlib.file_digest(content, "sha256").hexdigest()] = path
    if lacking := [file for file in recording.files if file.sha256 not in found]:
        names = ", ".join(unquote(Path(file.url).name) for file in lacking)
        raise SourceError(f"--file: {names} of {recording.source} is missing or has another SHA-256; download it again")
    for file in recording.files:
        (recording.parts / file.to).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(found[file.sha256], recording.parts / file.to)
