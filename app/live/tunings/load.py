"""A tuning version put in force in a running twin."""

from __future__ import annotations

from estimators.errors import ConfigError
from estimators.fold import Fold
from estimators.log import Log

from ...twin.twin import with_version
from ..interface import Running
from ..reload import obstacle


def load_into(engine: Running, name: str, why: str | None = None) -> None:
    """Queue going on with a version of the twin; the history is folded again with it.

    Args:
        engine: What runs.
        name: Of the version, or `own`.
        why: What is said of the run that begins; None for the version's name.

    Raises:
        ConfigError: If there is no such version, it is wrong, or it does not fit what runs.
    """
    twin = with_version(engine.twin, name)
    reason = obstacle(engine.twin, twin)
    if reason is not None:
        raise ConfigError(f"{name}: {reason}; start the twin with --tuning {name}")
    # Compiled before the engine's thread asks for it.
    Fold(twin.estimator, twin.model, twin.tuning, Log.of(twin.model), pairs=twin.pairs, idle=True)
    engine.reload(twin, f"version {name}" if why is None else why, exact=True)
