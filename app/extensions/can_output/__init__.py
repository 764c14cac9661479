"""Frames on a CAN bus: the estimate as a virtual sensor, `outputs: {can: ...}`, and a simulated asset, `nisus bus`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={"bus": Part(f"{__name__}.arguments:BusCommand", f"{__name__}.bus:play_bus")},
    outputs={
        "can": Part(
            f"{__name__}.schema:CanOutputSection",
            f"{__name__}.output:CanOutput",
            "CAN bus on which the estimate is a virtual sensor: {interface, channel, id, dbc, ...}. Default: none.",
        )
    },
)
