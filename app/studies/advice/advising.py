"""Advice on the running twin's estimator, by what its own log shows: measured when asked, in a thread of its own."""

from __future__ import annotations

import os
import sys
import threading
import time
from dataclasses import dataclass, replace
from typing import Any

from estimators.errors import ConfigError, NisusError

from ...live.history_copy import copy_log
from ...live.integrity import LOWEST
from ...live.interface import Running

RUNNING, FAILED, DONE = "running", "failed", "done"


@dataclass
class Advising:
    """One at a time; the last is kept, with the `revision` of which it is. `told` is the advice as JSON, once known."""

    engine: Running
    state: str = "none"
    revision: int | None = None
    reason: str = ""
    told: dict[str, Any] | None = None
    begun: float = 0.0

    def begin(self) -> None:
        """Measure the log that is there.

        Raises:
            ConfigError: If that is being done, or would hold up what runs.
        """
        engine = self.engine
        if self.state == RUNNING:
            raise ConfigError("advice: the log is being measured; wait for it")
        if engine.model.black_box:
            raise ConfigError(f"advice: {engine.model.name} is a black box, too slow to be measured; use nisus advise")
        if engine.status().compiling:
            # What compiles holds the interpreter.
            raise ConfigError("advice: the filters that it compares are still being compiled; ask again then")
        self.state, self.told, self.reason, self.begun = RUNNING, None, "", time.monotonic()
        self.revision = engine.revisions.runs[-1].number
        threading.Thread(target=self._run, name="advice", daemon=True).start()

    def _run(self) -> None:
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST)
        from .advice_json import advice_json
        from .measured import Measured
        from .verdict import advise

        state = DONE
        try:
            tuning, estimator = self.engine.folded_with()
            log, _ = copy_log(self.engine, tuning)
            twin = replace(self.engine.twin, tuning=tuning, estimator=estimator)
            self.told = advice_json(twin, log, advise(Measured(twin, log)))
        except NisusError as error:
            state, self.reason = FAILED, str(error)
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            state, self.reason = FAILED, f"{type(error).__name__}: {error}"
        self.state = state
