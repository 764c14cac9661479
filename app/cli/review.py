"""`nisus review`: a recording on the page, folded again from its readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..recording.format import tuning_from_json
from ..recording.reader import read_recording
from ..server.port import check_port
from ..session import Page, Session
from ..stderr import complain
from ..twin.twin import Twin, restore_twin
from .prepare import prepare

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

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


def open_review(path: Path, page: Page | None) -> tuple[Session, Recorded]:
    """A session over the recorded readings: the same engine, the same fold.

    Raises:
        NisusError: If the recording cannot be read, its model is not there, or the page's port is in use.
    """
    if page is not None:
        check_port(page.port)
    recorded = read_recording(path)
    twin = recorded_twin(recorded)
    prepare(twin)

    def open_source(report: Callable[[str, str], None]) -> object:
        from sources.memory import MemorySource

        return MemorySource(recorded.events)

    session = Session(
        twin,
        open_source,  # type: ignore[arg-type]
        page=page,
        base=recorded.base,
        horizon=np.inf,
        review=path,
    )
    session.engine.notices.restore(recorded.notices)
    session.engine.notices.say(f"{path.name}: {recorded.rows} rows, {recorded.tunings} tuning(s), folded again")
    if not recorded.closed:
        cut = f"{path.name}: was not closed, as by a kill or a full disk; it is reviewed as far as it goes"
        session.engine.notices.say(cut, level="warn")
        complain(cut)
    return session, recorded


def review_recording(arguments: Review) -> int:
    """Carry the command out."""
    session, _ = open_review(arguments.file, Page(arguments.port, not arguments.no_browser))
    session.run(record=None, duration=arguments.duration, until_finished=False)
    return 0
