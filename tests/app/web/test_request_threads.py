"""Threads of requests: as many as stated from the first request on, results, errors, cancelled requests."""

import asyncio
import threading
from unittest.mock import AsyncMock

import pytest

from app.charts.series import Series
from app.web.request_threads import RequestThreads
from app.web.streams import PageStream
from tests.app.scripted import Stepped, notice_texts
from tests.waiting import LIMIT_S


def started_by(act):
    before = set(threading.enumerate())
    result = act()
    return result, set(threading.enumerate()) - before


def test_all_threads_start_with_the_first_request_and_none_with_more():
    threads, go_on = RequestThreads("test", 4), threading.Event()
    first, started = started_by(lambda: threads.submit(lambda: 7))
    assert first.result(LIMIT_S) == 7 and len(started) == 4
    busy = threading.Barrier(5)

    def wait():
        busy.wait(LIMIT_S)
        go_on.wait(LIMIT_S)
        return threading.current_thread()

    outcomes, more = started_by(lambda: [threads.submit(wait) for _ in range(4)])
    busy.wait(LIMIT_S)  # all four are at work
    queued, further = started_by(lambda: [threads.submit(threading.current_thread) for _ in range(20)])
    assert not more and not further and not any(item.done() for item in queued)
    go_on.set()
    assert {item.result(LIMIT_S) for item in outcomes + queued} == started


def test_an_error_is_the_request_s_and_the_thread_goes_on():
    threads = RequestThreads("test", 1)
    failed = threads.submit(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        failed.result(LIMIT_S)
    assert threads.submit(lambda: 3).result(LIMIT_S) == 3


def test_a_cancelled_request_ends_after_its_work():
    async def cancelled():
        begun, go_on, done = threading.Event(), threading.Event(), []

        def work(word, *, more):
            begun.set()
            go_on.wait(LIMIT_S)
            done.append(word + more)

        task = asyncio.ensure_future(RequestThreads("test", 2).run(work, "a", more="b"))
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
