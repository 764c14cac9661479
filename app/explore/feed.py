"""Feed of one browser's Rerun viewer.

There is no Rerun server. Each browser has a feed with a cursor and a stream of its own, and asks for the next bytes
when it has drawn the last ones. So a viewer that stops reading delays no other, and nothing is queued for it.

Each revision is another Rerun recording under the same paths. The viewer shows the newest, with the layout, zoom and
play state that the user chose, and the page closes the one before.
"""

from __future__ import annotations

import json
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr

from ..charts.colors import EITHER, Palette
from ..engine.copies import MAX_PULL_ROWS, Pull
from ..engine.history_copy import follow, joined
from ..engine.notices import MAX_LINES, Notice
from ..engine.running_fold import Running
from .rows import RerunRows
from .sink import free_closed_streams

HISTORY_STRETCHES = 3000  # Stretches into which a whole history is cut for drawing

FIRST_WINDOWS = 1.5
"""Length that a new revision sends first, in windows of the charts; the rest of a long history follows."""

FRAME_TIMELINE = "frame"
"""Timeline that counts the messages, from which the page reads how many the viewer has drawn."""

Message = str | bytes


class RerunFeed:
    """Messages for the viewer of one browser. Not thread-safe."""

    def __init__(self, engine: Running, *, layout: bool = True, palette: Palette = EITHER) -> None:
        """Create a feed; nothing is pulled yet.

        Args:
            engine: Source of the rows.
            layout: Whether the first recording has the blueprint; False if the viewer has it from an earlier feed.
            palette: Colours of the viewer's theme.
        """
        self._engine = engine
        self._cursor = engine.cursor()
        self._layout, self._palette = layout, palette
        self._frame = 0
        self._notices: deque[Notice] = deque(maxlen=MAX_LINES)
        self._name = uuid.uuid4().hex[:8]
        self.application = f"nisus_{engine.twin.name}"
        self._stream: rr.RecordingStream | None = None
        self._bytes: Any = None
        self._rows: RerunRows | None = None
        self._later: Callable[[], None] | None = None

    def next(self) -> list[Message]:
        """Return the next messages, if any: bytes for Rerun, or a line of JSON for the page.

        `{"recording": id}` announces that the following bytes belong to another recording. The k-th bytes of a
        recording end with row k of the timeline `FRAME_TIMELINE`.
        """
        if self._later is not None:
            later, self._later = self._later, None
            later()
            return self._read()
        pull = self._engine.pull(self._cursor, MAX_PULL_ROWS)
        if pull.fresh:
            pull = joined([pull, *follow(self._engine, self._cursor)], self._engine.model.width)
        self._notices.extend(pull.notices)
        if pull.fresh and self._rows is not None and not len(pull.events):
            # The source has just restarted: the charts stay as they are until there are rows.
            self._cursor.revision = -1
            return []
        if pull.fresh:
            return self._begin(pull)
        if self._rows is None or not (len(pull.events) or pull.notices or pull.pictures):
            return []
        self._rows(pull)
        return self._read()

    def close(self) -> None:
        """Release the cursor and the stream."""
        self._engine.release(self._cursor)
        self._end()

    def _end(self) -> None:
        """Close the stream of the recording so far, if there is one."""
        if self._stream is not None:
            self._stream.disconnect()
            self._stream = self._bytes = self._rows = self._later = None
            free_closed_streams()

    def _begin(self, pull: Pull) -> list[Message]:
        """Start another recording: first the window of the charts, then the rest."""
        self._end()
        name = f"{self._name}-{pull.revision}"
        self._stream = rr.RecordingStream(self.application, recording_id=name, send_properties=False)
        self._bytes = self._stream.binary_stream()
        rows = self._rows = RerunRows(
            self._stream, self._engine, series=HISTORY_STRETCHES, layout=self._layout, palette=self._palette
        )
        self._layout = False
        self._frame = 0
        announcement = json.dumps({"recording": f"Recording:{self.application}:{name}", "revision": pull.revision})
        t = pull.events.t
        first = int(FIRST_WINDOWS * rows.sink.window * 1e9)
        cut = int(np.searchsorted(t, t[-1] - first)) if t.size and pull.revision else 0
        before = self._engine.revisions.previous() if pull.revision and t.size else None
        # A recording's timeline must not begin before its rows, of which the oldest may have been dropped.
        grey = before.events.t if before is not None else t[:0]
        known = int(np.searchsorted(grey, t[0])) if t.size else 0
        grey_cut = max(known, int(np.searchsorted(grey, t[cut]))) if t.size else 0

        def draw(part: slice, grey_part: slice, past: bool) -> None:
            rows.rows(pull.events.select(part), pull.track.select(part), past=past)
            if before is not None and grey[grey_part].size:
                rows.previous(grey[grey_part], before.track.select(grey_part))
            begun = pull.first + cut
            rows.pictures([item for item in pull.pictures if (item.before <= begun) == past], past=past)

        if t.size:
            rows.begin(pull)
            draw(slice(cut, None), slice(grey_cut, None), past=False)
        # The engine gives a notice once, and the viewer loses it with the recording that it closes. Notices from before
        # the source restarted have later times than its rows, so they are left out.
        here = self._engine.notices.passage
        notices = (line for line in self._notices if line.passage == here)
        rows.notices(
            [
                line if line.revision == pull.revision else replace(line, text=f"revision {line.revision}: {line.text}")
                for line in notices
            ]
        )
        if cut:
            self._later = lambda: draw(slice(0, cut), slice(known, grey_cut), past=True)
        return [announcement, *self._read()]

    def _read(self) -> list[Message]:
        assert self._stream is not None
        self._frame += 1
        self._stream.send_columns(
            "/frame",
            indexes=[rr.TimeColumn(FRAME_TIMELINE, sequence=[self._frame])],
            columns=rr.AnyValues.columns(count=[self._frame]),
        )
        data = self._bytes.read()
        return [data] if data else []
