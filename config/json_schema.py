"""The JSON Schema of a twin's YAML, which editors use for completion and checks."""

from __future__ import annotations

import json
from typing import Any

from .schema import TwinSection


def json_schema() -> dict[str, Any]:
    """The schema, with a description of every key."""
    schema = TwinSection.model_json_schema(mode="validation")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "Nisus twin",
        "description": "A twin: a model of an asset, the source of its readings, and the estimator that joins them.",
    }


def json_schema_text() -> str:
    """The schema as the text of a file."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
