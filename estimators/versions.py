"""Which version of the model holds when: each maintenance begins another."""

from __future__ import annotations

import numpy as np

from .log import MAINTENANCE, Log


def maintenance_times(log: Log) -> np.ndarray:
    """Times (ns) of the maintenances that the log has kept, ascending."""
    return np.unique(log.t[: log.n][log.kind[: log.n] == MAINTENANCE])


def model_version_at(log: Log, t: int) -> int:
    """The version of the model at time t, ns."""
    return log.version + int(np.searchsorted(maintenance_times(log), t, side="right"))


def last_maintenance(log: Log, t: int) -> int | None:
    """Time (ns) of the last maintenance at or before t that the log has kept; None if there is none."""
    times = maintenance_times(log)
    k = int(np.searchsorted(times, t, side="right"))
    return int(times[k - 1]) if k else None
