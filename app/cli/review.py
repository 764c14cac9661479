"""`nisus review`: a recording on the page, folded again from its readings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..terminal import complain
from ..web.gallery.gallery import StartRequest
from ..web.port import check_port
from ..web.session import Page, Session
from .opener import FileOpener, open_session, opened_review
from .prepare import prepare

if TYPE_CHECKING:
    from ..web.running import Opening
    from .arguments import Review


def open_review(path: Path, page: Page | None, recordings: Path = Path()) -> tuple[Session, Opening]:
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
    return open_session(opening, StartRequest(recording=path), FileOpener(), page=page, recordings=recordings), opening


def review_recording(arguments: Review) -> int:
    """Carry the command out."""
    page = Page(arguments.port, not arguments.no_browser)
    session, _ = open_review(arguments.file, page, arguments.recordings)
    session.run(record=None, duration=arguments.duration, until_finished=False)
    return 0
