"""`nisus run`: a twin on its source, live or replayed, shown on the page."""

from __future__ import annotations

import functools
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from estimators.errors import ConfigError

from ..engine.execute import MAX_SPEED
from ..record.rrd_file import TAKEN, check_date, parse_split
from ..result import to_json
from ..terminal import complain
from ..web.access import grants_of
from ..web.gallery.gallery import StartRequest
from ..web.http_server import check_port
from ..web.session import Page, Session
from .open_twin import FileOpener, open_session, opened_review, opened_twin
from .options import overrides_of
from .prepare import prepare

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..engine.compilers import Compiler
    from ..web.running import OpenedTwin
    from .arguments import PageOptions, ReviewCommand, RunCommand

OPTIONS_OF_TWIN = ("record", "store", "archive", "log", "set", "estimator", "tuning")  # of a twin that is named

MAX_FAILURES = 5  # failures of the source that a run without a page prints at its end; errors are printed at once


def page_of(arguments: PageOptions) -> Page:
    """Return the page that the options describe."""
    grants = grants_of(arguments.tokens, arguments.public)
    return Page(arguments.port, not arguments.no_browser, grants, public=arguments.public)


def run_twin(arguments: RunCommand, workers: Sequence[Compiler] = ()) -> int:
    """Run the command; `workers` are idle compiler processes."""
    speed = arguments.speed
    if speed is not None and not (0.0 < speed <= MAX_SPEED or speed == math.inf):
        raise ConfigError(
            f"--speed {speed:g}: must be positive and at most {MAX_SPEED:g}, or inf for as fast as possible"
        )
    record = arguments.record
    if record is not None:
        if record.suffix != ".rrd":
            raise ConfigError(f"--record {record}: must end in .rrd")
        check_date(record)
        if os.path.lexists(record):
            raise ConfigError(f"--record {record}: {TAKEN}")
    if arguments.json and not arguments.headless:
        raise ConfigError("--json: is the result of a run without a page; give --headless")
    split = parse_split(arguments.record_split, arguments.record_keep)
    archived = parse_split(arguments.archive_split, arguments.archive_keep, "--archive")
    page = None if arguments.headless else page_of(arguments)
    opening, wanted, opener = None, None, FileOpener()
    if arguments.twin is not None:
        wanted = StartRequest(arguments.twin)
        read = functools.partial(
            opened_twin,
            arguments.twin,
            logs=arguments.log,
            overrides=overrides_of(arguments),
            speed=speed,
            store=arguments.store,
            archive=arguments.archive,
            split=archived,
        )
        opening, opener = read(), FileOpener({arguments.twin: read}, workers)
    elif page is None or any(getattr(arguments, name) for name in OPTIONS_OF_TWIN):
        raise ConfigError("run: the twin is missing; name one (`nisus twins` lists those that ship)")
    if page is not None:
        check_port(page.port)
    if opening is not None and page is None:
        prepare(opening.twin)
    elif opening is not None:
        opening = opener.made_ready(opening)
    session = open_session(
        opening, wanted, opener, page=page, split=split, recordings=arguments.recordings,
        printed=arguments.log_format is not None,
    )  # fmt: skip
    session.run(record=record, duration=arguments.duration, until_finished=arguments.headless)
    if arguments.headless:
        status = session.engine.status()
        lines = session.engine.notices.since(0)
        # A page would show that the source failed.
        failed = [line.text for line in lines if line.text.startswith("source failed")]
        failures = dict.fromkeys([*failed, *(line.text for line in lines if line.level == "error")])
        refits = [line.text for line in lines if line.text.startswith("refit ")]
        if arguments.json:
            print(to_json({"counts": status.counts, "failures": list(failures), "refits": refits}))
        else:
            print(", ".join(f"{name} {count}" for name, count in status.counts.items() if count or name == "readings"))
        for text in list(dict.fromkeys(failed))[:MAX_FAILURES]:
            complain(text)
        for k, text in enumerate(refits):
            if "adopted" in text or k >= len(refits) - MAX_FAILURES:
                complain(text)
        return 2 if failed else 0
    return 0


def open_review(path: Path, page: Page | None, recordings: Path = Path()) -> tuple[Session, OpenedTwin]:
    """Return a session over a recording, and its opened twin.

    Raises:
        NisusError: As `opened_review`, or if the page's port is in use.
    """
    if page is not None:
        check_port(page.port)
    opening = opened_review(path)
    prepare(opening.twin)
    for level, text in opening.remarks:
        if level == "warn":
            complain(text)
    return open_session(opening, StartRequest(recording=path), FileOpener(), page=page, recordings=recordings), opening


def review_recording(arguments: ReviewCommand) -> int:
    """Show a recording on a page, until Ctrl-C."""
    page = page_of(arguments)
    session, _ = open_review(arguments.file, page, arguments.recordings)
    session.run(record=None, duration=arguments.duration, until_finished=False)
    return 0
