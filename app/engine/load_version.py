"""Load a tuning version into the running twin."""

from __future__ import annotations

from estimators.errors import ConfigError

from ..twin.changes import obstacle
from ..twin.twin import with_version
from .engine import Engine


def load_into(engine: Engine, name: str, why: str | None = None) -> None:
    """Queue the change to a version of the twin, or to `own`; the history is folded again with it.

    `why` is the reason of the new run; None for the version's name.

    Raises:
        ConfigError: If there is no such version, it is wrong, or it does not fit the running twin.
    """
    twin = with_version(engine.twin, name)
    reason = obstacle(engine.twin, twin, from_prior=engine.rows(0, 0).first == 0)
    if reason is not None:
        raise ConfigError(f"{name}: {reason}; start the twin with --tuning {name}")
    # Compiled before the engine's thread asks for it.
    twin.fold(pairs=twin.pairs, idle=True)
    engine.reload(twin, f"version {name}" if why is None else why, exact=True)
