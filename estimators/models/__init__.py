"""The bundled models, by name."""

from __future__ import annotations

from ..model.state_space import StateSpaceModel
from .agv_corridor import AGV_CORRIDOR
from .battery_cell import BATTERY_CELL
from .battery_pack import BATTERY_PACK
from .field_era5 import FIELD_ERA5
from .gripper_contact import GRIPPER_CONTACT
from .lorenz import LORENZ63, LORENZ96
from .motor_drive import MOTOR_DRIVE, MOTOR_WINDING
from .road_car import ROAD_CAR
from .thermal_field import THERMAL_FIELD, THERMAL_FIELD_LARGE
from .uwb_rover import UWB_ROVER

MODELS: dict[str, StateSpaceModel] = {
    model.name: model
    for model in (
        MOTOR_WINDING,
        MOTOR_DRIVE,
        ROAD_CAR,
        BATTERY_CELL,
        BATTERY_PACK,
        LORENZ63,
        LORENZ96,
        THERMAL_FIELD,
        THERMAL_FIELD_LARGE,
        FIELD_ERA5,
        AGV_CORRIDOR,
        UWB_ROVER,
        GRIPPER_CONTACT,
    )
}
