"""Values as the text of a YAML."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
RESERVED = {"null", "true", "false"}


def as_section(name: str, items: Mapping[str, Any]) -> list[str]:
    """A section as lines, an entry each; none if it is empty."""
    return [f"{name}:", *(f"  {_key(key)}: {as_flow(value)}" for key, value in items.items())] if items else []


def _key(name: str) -> str:
    return name if PLAIN.fullmatch(name) and name.lower() not in RESERVED else json.dumps(name, ensure_ascii=False)


def as_flow(value: Any) -> str:
    """A value in one line of YAML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)}: {as_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(as_flow, value)) + "]"
    if isinstance(value, str):
        return _key(value)
    if isinstance(value, float) and value == round(value) and abs(value) < 1e15:
        return str(int(value))
    return json.dumps(value)
