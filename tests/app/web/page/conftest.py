"""Pages of sessions in Chromium."""

from urllib.parse import urlsplit

import pytest

from tests.app.web.page.browsed import DRAWN, running, until

OWN_NAMES = ("127.0.0.1", "localhost")


@pytest.fixture
def visit(browser):
    """visit(url): a page, once it has drawn. It may raise no exception, and ask no other host for anything.

    `beside` is a page whose window (cookies and storage) it shares; `asked` has the addresses that it requested. The
    scene is drawn only with `scene`: without a graphics card that takes more of the processor than all else.
    """
    wrong = []

    def visit(url, *, beside=None, ready=DRAWN, size=(1440, 900), scheme="light", scene=False):
        if beside is None:
            viewport = {"width": size[0], "height": size[1]}
            context = browser.new_context(viewport=viewport, color_scheme=scheme)
            if not scene:
                context.add_init_script("if (location.pathname.endsWith('/viser/')) window.stop()")
        page = (context if beside is None else beside.context).new_page()
        own = tuple(f"{scheme}://{name}:{urlsplit(url).port}/" for scheme in ("http", "ws") for name in OWN_NAMES)
        page.asked = []

        def note(request):
            page.asked.append(request.url)
            # What the policy of the page blocks is no request: Rerun's viewer calls home at its start, in vain.
            if not request.url.startswith((*own, "blob:", "data:")):
                wrong.append(request.url)

        page.on("request", note)
        page.on("websocket", lambda socket: socket.url.startswith(own) or wrong.append(socket.url))
        page.on("pageerror", lambda error: wrong.append(f"{error} {error.stack}"))
        page.goto(url)
        if ready is not None:
            until(page, ready)
        return page

    yield visit
    assert wrong == []


@pytest.fixture(scope="module")
def session():
    """The session of a test's module, unless it has its own."""
    with running("motor_winding") as session:
        yield session


@pytest.fixture
def page(visit, session):
    """The page of the session of the test's module."""
    return visit(session.url)
