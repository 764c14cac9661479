"""The types of sources, by name. Their schema is in config/source_schema.py; what opens one is here or in its file."""

from __future__ import annotations

from .asset import SIMULATOR
from .can import CAN, CAN_LOG
from .kind import Kind
from .recordings import MERGED, TABLE

SOURCES: dict[str, Kind] = {
    "simulator": SIMULATOR,
    "can": CAN,
    "can_log": CAN_LOG,
    "table": TABLE,
    "merged": MERGED,
}
"""By the `type` of the section."""
