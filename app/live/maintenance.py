"""Maintenance of the asset as a user tells it: checked before it becomes events of the log."""

from __future__ import annotations

from collections.abc import Sequence

from estimators.errors import ConfigError, nearest, printable, quoted
from estimators.model.state_space import StateSpaceModel

LONGEST = 200
"""Characters that say what was done."""


def check_maintenance(what: str, states: Sequence[str], model: StateSpaceModel) -> list[int]:
    """The indices of the states, ascending.

    Raises:
        ConfigError: If nothing says what was done, or a state is missing, unknown or named twice.
    """
    if not what.strip() or len(what) > LONGEST or printable(what) != what or "\n" in what:
        raise ConfigError(f"Maintenance: what is {quoted(what)}; say what was changed, in 1 to {LONGEST} characters")
    if not states:
        raise ConfigError("Maintenance: states is empty; name the states that it concerns")
    for name in states:
        if name not in model.state_names:
            raise ConfigError(
                f"Maintenance: {model.name} has no state {quoted(name)}; {nearest(name, model.state_names[:1000])}"
            )
    if len(set(states)) != len(states):
        raise ConfigError("Maintenance: states names one twice; name each once")
    return sorted(model.state_names.index(name) for name in states)
