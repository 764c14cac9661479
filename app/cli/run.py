"""`nisus run`: a twin on its source, live or replayed, shown on the page."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from estimators.errors import ConfigError

from ..engine.playback import FASTEST
from ..recording.format import TAKEN
from ..recording.split import NEVER, parse_split
from ..server.port import check_port
from ..session import Page, Session
from ..stderr import complain
from ..twin.twin import Twin, load_twin
from .arguments import settings
from .prepare import begin_to_compile, prepare, prepare_model
from .remarks import remarking

if TYPE_CHECKING:
    from sources.source import Source

    from .arguments import Run


def live_source(twin: Twin, speed: float) -> Callable[[Callable[[str, str], None]], Source]:
    """How to open the twin's source so that it comes in its own time: a bus as it is, anything else paced.

    The faults that were injected last when a bus is opened again.
    """
    faults = twin.faults()
    return lambda report: twin.open_source(remarking(report), speed=speed, faults=faults)


SAID = 5
"""Failures that a run without a page prints at its end, since it has no list of events."""


def run_twin(arguments: Run) -> int:
    """Carry the command out."""
    if not (0.0 < arguments.speed <= FASTEST or arguments.speed == math.inf):
        raise ConfigError(
            f"--speed {arguments.speed:g}: must be positive and at most {FASTEST:g}, or inf for as fast as possible"
        )
    if arguments.record is not None and arguments.record.suffix != ".rrd":
        raise ConfigError(f"--record {arguments.record}: must end in .rrd")
    if arguments.record is not None and os.path.lexists(arguments.record):
        raise ConfigError(f"--record {arguments.record}: {TAKEN}")
    split = NEVER if arguments.record_split is None else parse_split(arguments.record_split)
    twin = load_twin(
        arguments.twin, log_files=arguments.log or None, overrides=settings(arguments.set, arguments.estimator)
    )
    page = None if arguments.headless else Page(arguments.port, not arguments.no_browser)
    if page is not None:
        check_port(page.port)
    workshop = None
    if page is None:
        prepare(twin)
    else:
        workshop = begin_to_compile(twin)
        prepare_model(twin)
    session = Session(twin, live_source(twin, arguments.speed), page=page, split=split, workshop=workshop)
    session.run(record=arguments.record, duration=arguments.duration, until_finished=arguments.headless)
    if arguments.headless:
        status = session.engine.status()
        print(", ".join(f"{name} {count}" for name, count in status.counts.items() if count or name == "readings"))
        lines = session.engine.notices.since(0)
        # What a page shows of a source that ended in the midst, nobody would see here.
        failed = [line.text for line in lines if line.text.startswith("source failed")]
        failures = dict.fromkeys([*failed, *(line.text for line in lines if line.level == "error")])
        for text in list(failures)[:SAID]:
            complain(text)
        return 2 if failed else 0
    return 0
