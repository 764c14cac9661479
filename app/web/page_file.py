"""A file of the page, told what it must know before it can ask."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starlette.responses import Response

PAGE = Path(__file__).parent / "page"


def page_file(name: str, settings: Mapping[str, Any]) -> Response:
    """The HTML file of that name, with the settings in an attribute of its body."""
    # In an attribute, not in a script: the policy allows no inline ones.
    quoted = json.dumps(dict(settings)).replace("&", "&amp;").replace('"', "&quot;")
    return Response((PAGE / name).read_text().replace("{{settings}}", quoted), media_type="text/html")
