"""Recordings on the cards of the gallery: size, host and licence of a download, and the download in a job."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import wait
from functools import partial
from pathlib import Path

from app.engine.jobs import start_in_thread
from app.result import JsonObject
from app.web.gallery.dropped_logs import ReaderJob
from app.web.http import get, post
from estimators.errors import ConfigError

from .sets import RecordingSet, find, recordings

REPORT_PERIOD_S = 0.2  # Time between two reports of progress

jobs: list[ReaderJob] = []
"""The last download of this process, which has one at a time."""


def state() -> JsonObject:
    """Return the recordings of the bundled twins, and the last download."""
    last = [{"name": job.name, "state": job.state, "doing": job.item or "", "error": job.error} for job in jobs]
    return {"recordings": [each.as_json() for each in recordings().values()], "job": last[0] if last else None}


def begin(name: str) -> JsonObject:
    """Begin to download a recording."""
    recording = find(name)
    if recording.by_hand:
        raise ConfigError(f"{name}: {recording.by_hand}")
    if jobs and not jobs[0].over:
        raise ConfigError(f"{jobs[0].name} is being downloaded; wait for it")
    jobs[:] = [ReaderJob(downloaded, recording.folder, recording)]
    return state()


def downloaded(folder: Path, recording: RecordingSet) -> Iterator[str]:
    """Download a recording in a process of its own, as the conversion would delay a twin; yield the progress."""
    from .download import get

    over = start_in_thread(lambda: get(recording), "download")
    while not over.done():
        yield recording.progress()
        wait([over], REPORT_PERIOD_S)
    over.result()


state_route = partial(get, "/api/gallery/data", state)
"""Return the route of the recordings and the last download."""

begin_route = partial(post, "/api/gallery/data/get", begin, status=202)
"""Return the route that begins a download."""
