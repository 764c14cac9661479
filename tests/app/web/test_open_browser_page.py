"""A real browser that is given the file in place of the address, and one that outlives its session."""

import pytest

from app.live.engine import Engine
from app.web.server import PageServer
from app.web.session import BrowserPage
from tests.app.scripted import Scripted, wait_for
from tests.app.served import SECRET, shown_twin
from tests.app.web.page.browsed import PATIENCE

pytestmark = pytest.mark.browser


def test_the_file_opens_the_page_and_the_next_session_asks_for_its_own_address(browser, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    engine = Engine(shown_twin(), lambda report: Scripted())
    server = PageServer(engine, port=0, viser_port=None, secret=SECRET)
    server.start()
    opening = BrowserPage(server.url)
    page = browser.new_context().new_page()
    try:
        page.goto(opening.path.as_uri())
        page.locator("#connection[data-state=live]").wait_for(state="attached", timeout=PATIENCE * 1000)
        # The token is in a cookie then, no longer in the address.
        assert page.url == f"http://127.0.0.1:{server.port}/" and server.entered.is_set()
        page.reload()
        page.locator("#connection[data-state=live]").wait_for(state="attached", timeout=PATIENCE * 1000)
        server.stop()
        wait_for(lambda: "trying again" in page.locator("#connection").inner_text(), PATIENCE)
        server = PageServer(engine, port=server.port, viser_port=None, secret=SECRET)
        server.start()
        page.get_by_text("This session has ended").wait_for(timeout=PATIENCE * 1000)
        page.screenshot(path=str(tmp_path / "ended.png"))
    finally:
        page.context.close()
        opening.close()
        server.stop()
