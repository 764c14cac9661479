"""The models that ship, by name."""

from __future__ import annotations

from ..model import StateSpaceModel
from .lorenz63 import LORENZ63
from .lorenz96 import LORENZ96
from .motor_drive import MOTOR_DRIVE
from .motor_winding import MOTOR_WINDING
from .road_car import ROAD_CAR
from .thermal_field import THERMAL_FIELD

MODELS: dict[str, StateSpaceModel] = {
    model.name: model for model in (MOTOR_WINDING, MOTOR_DRIVE, ROAD_CAR, LORENZ63, LORENZ96, THERMAL_FIELD)
}
