"""An answer to what a request asks in JSON, or its refusal in one line."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from estimators.errors import NisusError

from .api import Json, one_line
from .bounds import TooLarge, bounded_body


async def answered(request: Request, take: Callable[[Any], Awaitable[Response]]) -> Response:
    """What `take` makes of a request's JSON; its refusal as one line."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        return PlainTextResponse("Nisus: Content-Type must be application/json.\n", 415)
    try:
        text = await bounded_body(request)
        try:
            body = json.loads(text)
        except (ValueError, RecursionError):
            return Json({"error": "the body is no JSON, or holds a number or a nesting that is too large"}, 400)
        return await take(body)
    except TooLarge as error:
        return PlainTextResponse(f"Nisus: {error}.\n", 413)
    except (NisusError, ValueError, RecursionError) as error:
        return Json({"error": one_line(str(error))}, 400)
