"""The types of sources: one line each. Its schema is in config/source_schema.py, the rest in its own file."""

from __future__ import annotations

from .source_can import CAN
from .source_can_log import CAN_LOG
from .source_kind import Kind
from .source_merged import MERGED
from .source_simulator import SIMULATOR
from .source_table import TABLE

SOURCES: dict[str, Kind] = {
    "simulator": SIMULATOR,
    "can": CAN,
    "can_log": CAN_LOG,
    "table": TABLE,
    "merged": MERGED,
}
"""By the `type` of the section."""
