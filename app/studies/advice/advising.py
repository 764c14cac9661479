"""Advice on the running twin's estimator, measured on its own log as a background job."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from estimators.errors import ConfigError

from ...live.history_copy import copy_log
from ...live.jobs import RUNNING, Job
from ...live.running_fold import Running


class Advising:
    """Measures one log at a time and keeps the last result with its `revision`."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._job: Job | None = None
        self.revision: int | None = None

    @property
    def state(self) -> str:
        """That of the job, or "none"."""
        return "none" if self._job is None else self._job.state

    @property
    def reason(self) -> str:
        """Why it failed."""
        return "" if self._job is None else self._job.reason

    @property
    def advice(self) -> dict[str, Any]:
        """The advice as JSON, once the state is done."""
        return {} if self._job is None else self._job.result

    def begin(self) -> None:
        """Measure the log.

        Raises:
            ConfigError: If it is being measured, or measuring would hold up the running twin.
        """
        engine = self._engine
        if self.state == RUNNING:
            raise ConfigError("advice: the log is being measured; wait for it")
        if engine.model.black_box:
            raise ConfigError(f"advice: {engine.model.name} is a black box, too slow to be measured; use nisus advise")
        if engine.status().compiling:
            # Compiling holds the interpreter.
            raise ConfigError("advice: the filters that it compares are still being compiled; ask again then")
        self.revision = engine.revisions.runs[-1].number
        self._job = engine.jobs.run("advice", self.measure, failed=lambda reason: None)

    def measure(self, job: Job) -> dict[str, Any]:
        """Return the advice on a copy of the log, as JSON."""
        from .measured import Measured
        from .verdict import advice_json, advise

        tuning, estimator = self._engine.folded_with()
        log, _ = copy_log(self._engine, tuning, check=job.check)
        twin = replace(self._engine.twin, tuning=tuning, estimator=estimator)
        return advice_json(twin, log, advise(Measured(twin, log)))
