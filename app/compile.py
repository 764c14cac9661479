"""Compiling, with a line that says so: it happens once, and takes longer than anything else a user waits for."""

from __future__ import annotations

import sys
import threading
import time

from rich.console import Console

from estimators.fold import Fold
from estimators.log import Log

from .twin import Twin

PATIENCE = 1.0
"""Seconds before the line appears; loading from the cache takes less."""


def prepare(twin: Twin) -> None:
    """Compile the twin's model and estimator, or load them from the cache.

    Raises:
        NisusError: If the model does not compile, or the estimator does not apply.
    """
    failure: list[BaseException] = []

    def work() -> None:
        try:
            Fold(twin.estimator, twin.model, twin.tuning, Log(twin.model.width), pairs=twin.pairs)
        except BaseException as error:  # noqa: BLE001  raised again below, in the caller's thread
            failure.append(error)

    begun = time.monotonic()
    thread = threading.Thread(target=work, name="compile", daemon=True)
    thread.start()
    thread.join(PATIENCE)
    if thread.is_alive():
        console = Console(file=sys.stderr)
        with console.status("compiling filters, once") as status:
            while thread.is_alive():
                thread.join(0.5)
                status.update(f"compiling filters, once: {time.monotonic() - begun:.0f} s")
        console.print(f"compiled filters, once: {time.monotonic() - begun:.0f} s", highlight=False)
    if failure:
        raise failure[0]
