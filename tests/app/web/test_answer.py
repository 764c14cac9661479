"""What is no JSON is refused in words of ours, on one line."""

import asyncio

import pytest
from starlette.requests import Request

from app.web.answer import answered
from app.web.api import Json


def refusal(body):
    """Status and body of the answer to these bytes."""

    async def receive():
        return {"type": "http.request", "body": body, "more_body": False}

    async def take(asked):
        return Json({"asked": asked})

    headers = [(b"content-type", b"application/json")]
    request = Request({"type": "http", "method": "POST", "path": "/", "query_string": b"", "headers": headers}, receive)
    response = asyncio.run(answered(request, take))
    return response.status_code, bytes(response.body).decode()


@pytest.mark.parametrize("body", [b"", b"{", b"\xff\xfe", b"[" * 30_000, b"1" * 5000])
def test_what_is_no_json_is_refused_in_our_words(body):
    status, text = refusal(body)
    assert status == 400
    assert "the body is no JSON" in text


def test_json_is_taken():
    assert refusal(b"[1]") == (200, '{"asked":[1]}')
