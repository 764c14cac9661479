"""The session's process: free memory between used blocks goes back to the system."""

import os
import resource
import sys
from pathlib import Path

import pytest

from app.web import session

BLOCK, COUNT = 16_000, 4_000  # bytes of a block: several pages, and less than glibc maps apart


def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


@pytest.mark.skipif(sys.platform != "linux" or not os.confstr("CS_GNU_LIBC_VERSION"), reason="glibc only")
def test_free_blocks_between_used_ones_are_returned(monkeypatch):
    kept, before = [], []

    def fragment():
        blocks = [bytes([1]) * BLOCK for _ in range(COUNT)]
        kept.extend(blocks[::2])
        blocks.clear()
        before.append(resident())

    monkeypatch.setattr(session, "_settle", fragment)
    monkeypatch.setattr(session, "TRIM_PERIOD_S", 0.0)
    session.Session(None, page=None).run(record=None, duration=0.5, until_finished=False)
    # Of each free block of 16,000 bytes two whole pages of 4,096 at least.
    assert before[0] - resident() > 0.9 * (COUNT // 2) * 2 * 4096


def test_the_address_of_a_page_is_that_of_its_proxy_or_service():
    pages = [session.Page(0, False, **named) for named in ({}, {"public": "https://a.example"}, {"site": "x/y"})]
    servers = [session.Session(None, page=page).http_server for page in pages]
    own = f"http://127.0.0.1:{servers[0].port}"
    assert [server.site for server in servers] == [own, "https://a.example", "x/y"]
    for server in servers:
        server.stop()
