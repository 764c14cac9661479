"""Pure numerics: models, the log, the fold, the filters, diagnostics. No I/O, no clock.

Names for scripts are loaded on first use: `import estimators` compiles nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .diagnostics.consistency import mean_nees as mean_nees
    from .diagnostics.health import HealthPolicy as HealthPolicy
    from .errors import NisusError as NisusError
    from .fleet.fleet import Fleet as Fleet
    from .fusion import covariance_intersection as covariance_intersection
    from .fusion import fuse as fuse
    from .interface.by_name import fold as fold
    from .interface.by_name import fold_many as fold_many
    from .log import Log as Log
    from .model.rk4 import rk4 as rk4
    from .model.state_space import Field as Field
    from .model.state_space import Input as Input
    from .model.state_space import Jump as Jump
    from .model.state_space import Limits as Limits
    from .model.state_space import Noise as Noise
    from .model.state_space import Parameter as Parameter
    from .model.state_space import Row as Row
    from .model.state_space import Sensor as Sensor
    from .model.state_space import State as State
    from .model.state_space import StateSpaceModel as StateSpaceModel
    from .model.state_space import Stuck as Stuck
    from .models import MODELS as MODELS
    from .registry import ESTIMATORS as ESTIMATORS
    from .tuning import Tuning as Tuning

_HOMES = {
    "ESTIMATORS": "registry",
    "Fleet": "fleet.fleet",
    "HealthPolicy": "diagnostics.health",
    "Log": "log",
    "MODELS": "models",
    "NisusError": "errors",
    "Tuning": "tuning",
    "covariance_intersection": "fusion",
    "fold_many": "interface.by_name",
    "fuse": "fusion",
    "mean_nees": "diagnostics.consistency",
    "rk4": "model.rk4",
    **dict.fromkeys("Field Input Jump Limits Noise Parameter Row Sensor State StateSpaceModel Stuck".split(), "model"),
}

if not TYPE_CHECKING:  # type checkers have the names above
    __all__ = ["fold", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'estimators' has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), "fold", *_HOMES})


class _Package(ModuleType):
    """The package, whose `fold` is the function; importing the module estimators.fold would set its own name here."""

    @property
    def fold(self) -> Any:
        return import_module(".interface.by_name", __name__).fold

    @fold.setter
    def fold(self, module: ModuleType) -> None:
        """Leave the name to the function."""


sys.modules[__name__].__class__ = _Package
