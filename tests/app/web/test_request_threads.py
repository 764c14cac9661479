"""Threads of requests: their number, results, errors, cancelled requests."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from unittest.mock import AsyncMock

import pytest
from starlette.responses import PlainTextResponse

from app.charts.series import Series
from app.web.http_server import HttpServer
from app.web.request_threads import REQUEST_THREADS, in_thread
from app.web.streams import PageStream
from tests.app.scripted import Stepped, notice_texts
from tests.waiting import LIMIT_S, wait_for


def test_requests_share_the_stated_number_of_threads():
    served, go_on, at_work = HttpServer(0), threading.Event(), []

    def wait():
        at_work.append(threading.current_thread())
        go_on.wait(LIMIT_S)
        if len(at_work) == 7:
            raise ValueError("the seventh")
        return PlainTextResponse("here")

    async def answer(scope, receive, send):
        try:
            found = await in_thread(wait)
        except ValueError as error:
            found = PlainTextResponse(str(error))
        await found(scope, receive, send)

    def ask(_):
        connection = HTTPConnection("127.0.0.1", served.port, timeout=LIMIT_S)
        connection.request("GET", "/api/x", headers={"Authorization": f"Bearer {served.token}"})
        return connection.getresponse().read()

    served.show(answer)
    served.start()
    with ThreadPoolExecutor(REQUEST_THREADS + 3) as browsers:
        answers = browsers.map(ask, range(REQUEST_THREADS + 3))
        wait_for(lambda: len(at_work) == REQUEST_THREADS)
        go_on.set()
        assert sorted(set(answers)) == [b"here", b"the seventh"] and len(set(at_work)) == REQUEST_THREADS
    served.stop()


def test_a_cancelled_request_ends_after_its_work():
    async def cancelled():
        begun, go_on, done = threading.Event(), threading.Event(), []

        def work(word, *, more):
            begun.set()
            go_on.wait(LIMIT_S)
            done.append(word + more)

        task = asyncio.ensure_future(in_thread(work, "a", more="b"))
        assert await asyncio.to_thread(begun.wait, LIMIT_S)
        task.cancel()
        asyncio.get_running_loop().call_later(0.05, go_on.set)
        with pytest.raises(asyncio.CancelledError):
            await task
        assert done == ["ab"]

    asyncio.run(cancelled())


def test_a_browser_that_leaves_while_it_is_told_is_no_error():
    """Once a message could not be sent, Starlette refuses to receive."""
    left = RuntimeError('WebSocket is not connected. Need to call "accept" first.')
    browser = AsyncMock(receive_text=AsyncMock(side_effect=left))
    engine = Stepped().engine
    asyncio.run(PageStream(browser, engine, Series(engine), dict, "boot").run())
    browser.receive_text.assert_awaited_once()
    assert notice_texts(engine) == []
