"""Section of the YAML: the estimate on a CAN bus."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from config.fields import Section, Text


class CanOutputSection(Section):
    """The estimate as frames on a CAN bus, two for each state, described by a DBC."""

    interface: Text
    """Interface of python-can: socketcan, virtual, udp_multicast, ..."""
    channel: Annotated[int, Field(strict=True)] | str
    """Channel of the interface."""
    options: dict[str, object] = {}
    """Further arguments of python-can's interface. Default: none."""
    id: Annotated[int, Field(strict=True, ge=0, le=0x1FFFFFFF)]
    """Identifier of the first frame; each state takes two. None may be one of the source's databases."""
    extended: Annotated[bool, Field(strict=True)] = False
    """Whether the identifiers have 29 bits. Default: false, 11 bits."""
    dbc: Text
    """DBC file that is written when the twin starts, beside this YAML."""
