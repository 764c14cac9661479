"""The estimate as a virtual sensor on a CAN bus: `outputs: {can: ...}`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    outputs={
        "can": Part(
            f"{__name__}.schema:CanOutputSection",
            f"{__name__}.output:CanOutput",
            "CAN bus on which the estimate is a virtual sensor: {interface, channel, id, dbc, ...}. Default: none.",
        )
    }
)
