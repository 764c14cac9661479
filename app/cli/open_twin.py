"""Open a twin or a recording to run it, for a command and for the gallery."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from config.extensions import maker
from config.loader import shipped

from ..record.rrd_file import NEVER, Split
from ..twin.log_reader import remarking
from ..twin.twin import Twin, load_twin, restore_twin
from ..web.gallery.api import GalleryApi
from ..web.gallery.gallery import Gallery, Opener, SavedFiles, StartRequest
from ..web.gallery.recordings import Recordings
from ..web.running import OpenedTwin, stamp_of
from ..web.session import Page, Session
from .prepare import begin_to_compile, compile_for

if TYPE_CHECKING:
    from sources.source import Source

    from ..engine.compilers import Compiler
    from ..record.reader import ReadRecording


def live_source(twin: Twin, speed: float | None = None) -> Callable[[Callable[[str, str], None]], Source]:
    """How to open the twin's source so that it comes in its own time: a bus as it is, anything else paced.

    The faults that were injected last when a bus is opened again. Unless `speed` is given, a recording is read to its
    end at once, and a simulation runs at the speed of the twin's YAML.
    """
    usual = math.inf if twin.plan.recorded else twin.config.view.speed
    faults, times = twin.plan.faults(), usual if speed is None else speed
    return lambda report: twin.open_source(remarking(report), speed=times, faults=faults)


def opened_twin(
    name: str,
    *,
    logs: Sequence[Path] = (),
    overrides: Mapping[str, str] | None = None,
    speed: float | None = None,
    store: Path | None = None,
    archive: Path | None = None,
    split: Split = NEVER,
) -> OpenedTwin:
    """A twin on its source, and how to read it again when its files were changed; `store` may be a folder.

    `archive` is the folder of all twins, `split` how its files are divided and kept.

    Raises:
        NisusError: If its YAML or its model is wrong.
    """

    def read() -> Twin:
        return load_twin(name, log_files=logs or None, overrides=overrides)

    twin = read()
    if store is not None and store.is_dir():
        store = store / f"{twin.name}.store"
    source = live_source(twin, speed)
    made = None
    if archive is not None:
        made = partial(maker("archives", "rows", "--archive", "archive"), archive / twin.name, split)
    stamp = stamp_of(twin.files)
    return OpenedTwin(twin, source, files=twin.files, stamp=stamp, again=read, store=store, archive=made)


def recorded_twin(recorded: ReadRecording) -> Twin:
    """The twin as it was when the recording ended: its YAML, with the last tuning and estimator.

    The baseline of the innovations is not part of the tuning and comes from the YAML.
    """
    from ..engine.fold_json import tuning_from_json

    twin = restore_twin(recorded.text, recorded.twin_path, recorded.overrides, recorded.version)
    tuning, estimator = tuning_from_json(recorded.tuning, twin.model, twin.tuning.baseline)
    return replace(twin, tuning=tuning, estimator=estimator, recorded=True)


def opened_review(path: Path) -> OpenedTwin:
    """Open a recording to fold it again. Its model is not compiled yet.

    Raises:
        NisusError: If the recording cannot be read, or its model is not there.
    """
    from ..record.reader import read_recording

    recorded = read_recording(path)

    def open_source(report: Callable[[str, str], None]) -> Source:
        from sources.merged import MemorySource

        return MemorySource(recorded.events)

    remarks = [("info", f"{path.name}: {recorded.rows} rows, {recorded.tunings} tuning(s), folded again")]
    if not recorded.closed:
        cut = f"{path.name}: was not closed (killed, or full disk); it is reviewed up to its last complete row"
        remarks.append(("warn", cut))
    twin = recorded_twin(recorded)
    base, remark = recorded.base_for(twin.model)
    remarks += [("warn", remark)] if remark else []
    return OpenedTwin(
        twin,
        open_source,
        base=base,
        horizon=np.inf,
        review=path,
        said=recorded.notices,
        annotations=recorded.annotations,
        remarks=remarks,
    )


class FileOpener:
    """Opens what the gallery asks for.

    `given` has twins with options from the command line; `workers` compile for the first.
    """

    def __init__(
        self, given: Mapping[str, Callable[[], OpenedTwin]] | None = None, workers: Sequence[Compiler] = ()
    ) -> None:
        self._given = dict(given or {})
        self._workers = workers

    def open(self, wanted: StartRequest) -> OpenedTwin:
        """See `Opener`."""
        if wanted.recording is not None:
            return opened_review(wanted.recording)
        name = wanted.twin or ""
        if name in self._given and not wanted.logs:
            return self._given[name]()
        return opened_twin(name, logs=wanted.logs)

    def made_ready(self, opening: OpenedTwin) -> OpenedTwin:
        """See `Opener`."""
        workers, self._workers = self._workers, ()
        compile_queue = begin_to_compile(opening.twin, workers)
        try:
            opening.twin.check_files()
            compile_for(opening.twin, compile_queue)
        except BaseException:
            compile_queue.stop()
            raise
        return replace(opening, compile_queue=compile_queue)

    def prepare(self, twin: Twin) -> None:
        """See `Opener`."""
        compile_for(twin)


def open_session(
    opening: OpenedTwin | None,
    wanted: StartRequest | None,
    opener: Opener,
    *,
    page: Page | None,
    split: Split = NEVER,
    recordings: Path = Path(),
    printed: bool = False,
) -> Session:
    """A session that runs what was opened, and on a page the gallery beside it.

    Raises:
        NisusError: If the source cannot be opened, or the page's port is in use.
    """
    session = Session(opening, page=page, split=split, recordings=recordings, printed=printed)
    if page is not None:
        own = [wanted.twin] if wanted is not None and wanted.twin is not None and wanted.twin not in shipped() else []
        gallery = Gallery(session, opener, first=wanted, own=own)
        if page.overview is None:
            GalleryApi(gallery, Recordings(recordings, lambda: session.recorded))
        session.starts = partial(SavedFiles, gallery)
    return session
