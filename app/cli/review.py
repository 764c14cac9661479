"""`nisus review`: a recording on the page, folded again from its readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..recording.format import tuning_from_json
from ..recording.reader import read_recording
from ..running import Opening
from ..server.port import check_port
from ..session import Page, Session
from ..stderr import complain
from ..twin.twin import Twin, restore_twin
from .prepare import prepare

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sources.source import Source

    from ..recording.reader import Recorded
    from .arguments import Review


def recorded_twin(recorded: Recorded) -> Twin:
    """The twin as it was when the recording ended: its YAML, with the last tuning and estimator.

    What was normal of the innovations is no knob, and stands in the YAML.
    """
    from dataclasses import replace

    twin = restore_twin(recorded.text, recorded.twin_path, recorded.overrides)
    tuning, estimator = tuning_from_json(recorded.tuning, twin.model)
    tuning = replace(tuning, baseline=twin.tuning.baseline)
    return replace(twin, tuning=tuning, estimator=estimator, recorded=True)


def opened_review(path: Path) -> Opening:
    """What a recording holds, to be folded again: the same engine, the same fold. Its model is not compiled yet.

    Raises:
        NisusError: If the recording cannot be read, or its model is not there.
    """
    recorded = read_recording(path)

    def open_source(report: Callable[[str, str], None]) -> Source:
        from sources.memory import MemorySource

        return MemorySource(recorded.events)

    remarks = [("info", f"{path.name}: {recorded.rows} rows, {recorded.tunings} tuning(s), folded again")]
    if not recorded.closed:
        cut = f"{path.name}: was not closed, as by a kill or a full disk; it is reviewed as far as it goes"
        remarks.append(("warn", cut))
    return Opening(
        recorded_twin(recorded),
        open_source,
        base=recorded.base,
        horizon=np.inf,
        review=path,
        said=recorded.notices,
        remarks=remarks,
    )


def open_review(path: Path, page: Page | None) -> tuple[Session, Opening]:
    """A session over the recorded readings, and what it runs.

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
    return Session(opening, page=page), opening


def review_recording(arguments: Review) -> int:
    """Carry the command out."""
    session, _ = open_review(arguments.file, Page(arguments.port, not arguments.no_browser))
    session.run(record=None, duration=arguments.duration, until_finished=False)
    return 0
