"""Registers of a Modbus TCP device as source: `source: {type: modbus, ...}`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    sources={"modbus": Part(f"{__name__}.schema:ModbusSourceSection", f"{__name__}.source:open_modbus")}
)
