"""Where drawings go: columns of one Rerun stream, on one timeline, below one root."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings

from estimators.model.state_space import StateSpaceModel

from ..charts.colors import RGB, Palette, mixed
from ..format_time import FIRST_DATED_NS


def send_blueprint(stream: rr.RecordingStream, layout: rrb.Blueprint) -> None:
    """Send a layout into a stream.

    `RecordingStream.send_blueprint` (Rerun 0.41) does the same but never disconnects the stream that it makes for the
    layout, which then refers to itself: two threads are left each time.
    """
    application = stream.get_application_id()
    made = rerun_bindings.new_blueprint(
        application_id=application, make_default=False, make_thread_default=False, default_enabled=True
    )
    blueprint = rr.RecordingStream._from_native(made)
    blueprint.set_time("blueprint", sequence=0)
    layout._log_to_stream(blueprint)
    storage = blueprint.memory_recording().storage
    rerun_bindings.send_blueprint(storage, True, True, recording=stream.to_native())
    blueprint.disconnect()


def free_closed_streams() -> None:
    """End the threads and free the memory of every stream to which nothing refers any more.

    Rerun keeps each stream in a list of its own, with two threads and about 3 MB, also after `disconnect`. This flushes
    all streams, so that none loses a row, and drops those that only that list refers to
    (`rerun_py/src/python_bridge.rs` of Rerun 0.41). So call it after the last reference to a stream is gone.
    """
    rerun_bindings.flush_and_cleanup_orphaned_recordings()


class Sink:
    """Logs columns over time, below the path `root`; `window` is the length of the charts in seconds."""

    def __init__(self, stream: rr.RecordingStream, *, window: float) -> None:
        self.stream = stream
        self.window = window
        self.root = ""
        self._calendar: bool | None = None

    def started(self, t: int) -> None:
        """Decide by the first time (ns) whether all are dates or durations."""
        if self._calendar is None:
            self._calendar = t >= FIRST_DATED_NS

    def times(self, t: np.ndarray) -> rr.TimeColumn:
        """Return times (ns) as a column of the timeline."""
        if self._calendar:
            return rr.TimeColumn(TIMELINE, timestamp=t.astype("datetime64[ns]"))
        return rr.TimeColumn(TIMELINE, duration=t.astype("timedelta64[ns]"))

    def static(self, path: str, what: rr.AsComponents) -> None:
        """Log values that apply at every time."""
        self.stream.log(f"{self.root}{path}", what, static=True)

    def gap(self, path: str, t: np.ndarray) -> None:
        """Clear a path at some times, until its next values."""
        if t.size:
            clear = rr.Clear.columns(is_recursive=np.zeros(t.size, bool))
            self.stream.send_columns(f"{self.root}{path}", indexes=[self.times(t)], columns=clear)

    def line(
        self,
        path: str,
        t: np.ndarray,
        values: np.ndarray,
        width: int,
        *,
        by_first: bool = False,
        gaps: bool | np.ndarray = False,
    ) -> None:
        """Log values (n, k) that are finite, thinned by their lowest and highest, or by those of the first column.

        Rows that are not finite are left out; where `gaps` is true the line has a gap there.
        """
        good = np.isfinite(values).all(axis=1)
        ends = ~good & gaps
        self.gap(path, t[ends & ~np.append(False, ends[:-1])])
        t, values = t[good], values[good]
        if not t.size:
            return
        key = values[:, :1] if by_first else values
        rows = thin(t, key.min(axis=1), key.max(axis=1), width)
        self.columns(path, t[rows], rr.Scalars.columns(scalars=np.ascontiguousarray(values[rows])))

    def columns(self, path: str, t: np.ndarray, what: rr.ComponentColumnList) -> None:
        """Log columns of one component, one row per time."""
        self.stream.send_columns(f"{self.root}{path}", indexes=[self.times(t)], columns=what)


NOTICES_PATH = "/events"  # Path of the notices of all revisions

TIMELINE = "time"

SCALE_GAP = 0.05
"""Gap between the picture of a field and its scale, and width of the scale, as shares of the picture's width."""


def state_colors(names: Sequence[str], palette: Palette) -> np.ndarray:
    """Return the colours of health states as Rerun packs them, (n,) uint32; other states are grey."""
    colors = [palette.health.get(name, palette.faint) for name in names]
    return np.array([(r << 24) | (g << 16) | (b << 8) | 255 for r, g, b in colors], np.uint32)


def band_color(palette: Palette) -> RGB:
    """Return the colour of the lines at ± 2 σ and of secondary parts of the estimate."""
    return mixed(palette.estimate, palette.panel, 0.45)


def with_unit(name: str, unit: str) -> str:
    """Return the title of a chart, for example `gnss speed [m/s]`."""
    words = name.replace("_", " ").replace(".", " ")
    return words if unit in ("", "1") else f"{words} [{unit}]"


def row_title(model: StateSpaceModel, sensor: int, row: int) -> str:
    """Return the title of one sensor row."""
    return with_unit(model.row_names[model.row_start[sensor] + row], model.sensors[sensor].rows[row].unit)


def pair_name(model: StateSpaceModel, pair: Sequence[int] | np.ndarray) -> str:
    """Return the entity name of a pair of states."""
    return f"{model.state_names[pair[0]]}_{model.state_names[pair[1]]}"


def last_of_each_time(t: np.ndarray) -> np.ndarray:
    """Indices of the last row of each distinct time, of times in order."""
    return np.flatnonzero(np.append(t[1:] != t[:-1], np.ones(min(t.size, 1), bool)))


def thin(t: np.ndarray, low: np.ndarray, high: np.ndarray, width: int) -> np.ndarray:
    """Rows to draw, at most two of each stretch of `width` nanoseconds, and the last row of all.

    Args:
        t: Times in order, shape (n,).
        low: The lowest row of each stretch by this is kept, shape (n,); finite.
        high: The highest by this too.
        width: Nanoseconds; zero keeps every row.
    """
    if width <= 0 or t.size <= 2:
        return np.arange(t.size)
    stretch = t // width
    starts = np.flatnonzero(np.append(True, stretch[1:] != stretch[:-1]))
    if 2 * starts.size >= t.size:
        return np.arange(t.size)
    group = np.cumsum(np.append(0, stretch[1:] != stretch[:-1]))
    lowest = _first_of_groups(group, low == np.minimum.reduceat(low, starts)[group])
    highest = _first_of_groups(group, high == np.maximum.reduceat(high, starts)[group])
    return np.unique(np.concatenate((lowest, highest, [t.size - 1])))


def _first_of_groups(group: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Index of the first row of each group in which the mask holds."""
    rows = np.flatnonzero(mask)
    return rows[np.append(True, group[rows[1:]] != group[rows[:-1]])]


def last_of_stretch(t: np.ndarray, width: int) -> np.ndarray:
    """Indices of the last row of each stretch of `width` nanoseconds, of times in order."""
    return last_of_each_time(t // width if width > 0 else t)
