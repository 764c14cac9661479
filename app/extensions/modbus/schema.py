"""Section of the YAML: registers of a Modbus TCP device as source."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from config.channels import MessagesSection
from config.fields import Duration, Host, Port, Section, Text, refused

BIT_TABLES = ("coil", "discrete")
SIZES = {"int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "int64": 4, "uint64": 4, "float32": 2, "float64": 4}
"""Registers of a number, by its type."""


class RegisterSection(Section):
    """Where a Modbus device has a value."""

    address: Annotated[int, Field(strict=True, ge=0, le=65535)]
    """Address as sent, from 0 on: 0 for the register that many manuals call 40001 or 30001."""
    table: Literal["holding", "input", "coil", "discrete"] = "holding"
    """holding (4xxxx) or input (3xxxx) registers, or the bits coil (0xxxx) or discrete (1xxxx). Default: holding."""
    type: Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"] = "uint16"
    """Type of the number in the registers; bits have none. Default: uint16."""
    words: Literal["big", "little"] = "big"
    """Order of the registers of a longer number: big if the first one has its highest bits. Default: big."""

    @model_validator(mode="after")
    def _bit(self) -> RegisterSection:
        if self.table in BIT_TABLES and {"type", "words"} & self.model_fields_set:
            raise refused("relation", f"is {self.table}, a bit; leave type and words out, or read a register", "table")
        return self

    @property
    def size(self) -> int:
        """Registers, or bits, of the value."""
        return 1 if self.table in BIT_TABLES else SIZES[self.type]


def _register(value: object) -> object:
    return {"address": value} if isinstance(value, int) else value


class ModbusSourceSection(MessagesSection):
    """Registers of a Modbus TCP device, read again and again."""

    type: Literal["modbus"]
    """modbus"""
    host: Host
    """Name or address of the device."""
    port: Port = 502
    """Its port. Default: 502."""
    device: Annotated[int, Field(strict=True, ge=0, le=255)] = 1
    """Its number behind a gateway (unit identifier). Default: 1."""
    every: Duration = 1.0
    """Seconds between two readings. Each is a measurement: read no faster than the device measures. Default: 1."""
    registers: Annotated[
        dict[
            Text,
            Annotated[RegisterSection, BeforeValidator(_register, json_schema_input_type=int | RegisterSection)],
        ],
        Field(min_length=1),
    ]
    """Registers by the names of their values: {LT101: {address: 100, type: float32}, FT101: 102}."""
