"""Looks for a call of a model's function that does not return, in whatever thread it is."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from config.loader import shown_path
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.jit import plain

CALL_PATIENCE = 10.0
"""Seconds that one call of a model's function may take before a line names it."""


class CallWatch:
    """Looks at what all threads are doing, for a call of a model's function that does not return."""

    def __init__(self, model: StateSpaceModel, clock: Callable[[], float] = time.monotonic) -> None:
        functions = [("f", model.f), ("F", model.F), ("Q", model.Q), ("shape", model.shape)]
        for sensor in model.sensors:
            for what in ("h", "H", "log_likelihood"):
                functions.append((f"{what} of sensor {sensor.name}", getattr(sensor, what)))
        if model.jump is not None:
            functions.append(("jump.chances", model.jump.chances))
        codes = ((getattr(plain(item), "__code__", None), what) for what, item in functions)
        self._names = {code: what for code, what in codes if code is not None}
        self._model = model.name
        self._clock = clock
        self._seen: tuple[Any, float] | None = None

    def look(self) -> str | None:
        """One line when a call has been under way for CALL_PATIENCE, the first time that it has."""
        frame = self._call()
        if frame is None:
            self._seen = None
        elif self._seen is None or self._seen[0] is not frame:
            self._seen = (frame, self._clock())
        elif self._clock() - self._seen[1] >= CALL_PATIENCE:
            self._seen = (frame, float("inf"))
            return (
                f"{self._said(frame)} has not returned for {CALL_PATIENCE:g} s; if it loops for ever, Ctrl-C ends the "
                "program"
            )
        return None

    def where(self) -> str | None:
        """The call that is under way now, and where it is."""
        frame = self._call()
        return None if frame is None else self._said(frame)

    def _said(self, frame: Any) -> str:
        code = frame.f_code
        return f"{shown_path(Path(code.co_filename))}:{frame.f_lineno}: {self._names[code]} of the model {self._model}"

    def _call(self) -> Any:
        for thread_frame in sys._current_frames().values():
            frame: Any = thread_frame
            while frame is not None:
                if frame.f_code in self._names:
                    return frame
                frame = frame.f_back
        return None
