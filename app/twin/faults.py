"""The faults that a twin's YAML puts into its source, checked against the model."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import TYPE_CHECKING

from config.fault_schema import FaultSection
from config.loader import Loaded
from config.yaml_lines import Key
from estimators.model.state_space import StateSpaceModel

if TYPE_CHECKING:
    from sources.faults.fault import Fault


def read_faults(loaded: Loaded, sections: Sequence[FaultSection], key: Key, model: StateSpaceModel) -> list[Fault]:
    """The faults of a list.

    Raises:
        ConfigError: With file and line, if one does not fit the model.
    """
    from sources.faults.fault import Fault
    from sources.faults.kinds import problem

    found = []
    for k, section in enumerate(sections):
        given = section.model_dump()
        fault = Fault(**{**given, "end": inf if section.end is None else section.end})
        wrong = problem(fault, model)
        if wrong:
            field, text = wrong
            raise loaded.error((*key, k, field) if field else (*key, k), text)
        found.append(fault)
    return found
