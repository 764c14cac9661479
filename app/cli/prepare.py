"""Compiling, with a line that says so: it happens once, and takes longer than anything else a user waits for."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from config.loader import shown_path
from estimators.fold import Fold
from estimators.log import Log
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.jit import plain

from ..twin.twin import Twin

PATIENCE = 1.0
"""Seconds before the line appears; loading from the cache takes less."""

CALL_PATIENCE = 10.0
"""Seconds that one call of a model's function may take before a line names it."""


def prepare(twin: Twin) -> None:
    """Compile the twin's model and estimator, or load them from the cache.

    Raises:
        NisusError: If the model does not compile, or the estimator does not apply.
    """

    def work() -> None:
        Fold(twin.estimator, twin.model, twin.tuning, Log.of(twin.model), pairs=twin.pairs)

    attend(twin.model, work, "compiling filters, once", "compiled filters, once")


def attend(model: StateSpaceModel, work: Callable[[], Any], doing: str, done: str | None = None) -> Any:
    """Do work that runs a model, in a thread that may be left behind, so that Ctrl-C ends even a call without end.

    Args:
        model: Whose function is named on standard error if it does not return.
        work: What to do.
        doing: What is shown meanwhile, if it takes long.
        done: What is said behind it then.

    Returns:
        What the work returns.

    Raises:
        BaseException: What the work raises.
    """
    result: list[Any] = []
    failure: list[BaseException] = []

    def run() -> None:
        try:
            result.append(work())
        except BaseException as error:  # noqa: BLE001  raised again below, in the caller's thread
            failure.append(error)

    begun = time.monotonic()
    thread = threading.Thread(target=run, name="compile", daemon=True)
    thread.start()
    thread.join(PATIENCE)
    if thread.is_alive():
        console = Console(file=sys.stderr)
        watch = CallWatch(model)
        if not console.is_terminal:  # where the status below shows nothing
            console.print(f"{doing} ...", highlight=False, soft_wrap=True)
        with console.status(doing) as status:
            while thread.is_alive():
                thread.join(0.5)
                line = watch.look()
                if line is not None:
                    console.print(line, highlight=False, soft_wrap=True)
                status.update(f"{doing}: {time.monotonic() - begun:.0f} s")
        if done is not None:
            console.print(f"{done}: {time.monotonic() - begun:.0f} s", highlight=False)
    if failure:
        raise failure[0]
    return result[0]


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
