"""Fixtures of `app` that the tests of extensions use."""

from tests.app.conftest import browser, interruptible, nisus, shared_chromium, winding
from tests.app.engine.outputs.conftest import hook
from tests.app.twin.conftest import inside
from tests.app.web.conftest import serve
from tests.app.web.page.conftest import visit

__all__ = ["browser", "hook", "inside", "interruptible", "nisus", "serve", "shared_chromium", "visit", "winding"]
