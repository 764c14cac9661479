"""Advice on the running twin's estimator, measured on its own log as a background job."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from estimators.errors import ConfigError

from ...live.history_copy import copy_log
from ...live.jobs import Job
from ...live.running_fold import Running

if TYPE_CHECKING:
    from .measured import AdviceProgress


class Advising:
    """Measures one log at a time and keeps the last result with its `revision`."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._job: Job | None = None
        self._progress: AdviceProgress | None = None
        self._last: dict[str, Any] = {}
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
        """The last advice as JSON; a cancelled one leaves the one before."""
        return self._last

    def progress(self) -> dict[str, Any]:
        """Return the question that is being answered, the share done, and the seconds spent and left, about."""
        job, progress = self._job, self._progress
        if job is None or progress is None:
            return {"question": "", "share": None, "elapsed": 0.0, "left": None}
        share = progress.done / progress.expected if progress.expected else None
        return {
            "question": progress.question,
            "share": share,
            "elapsed": job.elapsed,
            "left": progress.left(job.elapsed),
        }

    def cancel(self) -> None:
        """Cancel the measurement; it ends after its current fold."""
        if self._job is not None:
            self._job.cancel()

    def begin(self) -> None:
        """Measure the log.

        Raises:
            ConfigError: If it is being measured, or measuring would hold up the running twin.
        """
        engine = self._engine
        if self._job is not None and not self._job.over:
            raise ConfigError("advice: the log is being measured; wait for it")
        if engine.model.black_box:
            raise ConfigError(f"advice: {engine.model.name} is a black box, too slow to be measured; use nisus advise")
        if engine.status().compiling:
            # Compiling holds the interpreter.
            raise ConfigError("advice: the filters that it compares are still being compiled; ask again then")
        self._progress = None
        self._job = engine.jobs.run("advice", self.measure, failed=lambda reason: None)

    def measure(self, job: Job) -> dict[str, Any]:
        """Return the advice on a copy of the log, as JSON."""
        from .measured import AdviceProgress, Measured, without_faults
        from .verdict import advice_json, advise

        engine = self._engine
        self._progress = AdviceProgress(check=job.check)
        revision = engine.revisions.runs[-1].number
        tuning, estimator = engine.folded_with()
        log, _ = copy_log(engine, tuning, check=job.check)
        twin = replace(engine.twin, tuning=tuning, estimator=estimator)
        clean, excluded = without_faults(twin, log, engine.episodes())
        found = advice_json(twin, log, advise(Measured(twin, clean, excluded, self._progress)))
        self._last, self.revision = found, revision
        return found
