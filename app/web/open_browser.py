"""Opens the page in the user's browser without showing its token to anybody else.

What a browser is started with can be read by every user of the machine. So it is given the name of a file that only
this user can read, and the file leads on to the page.
"""

from __future__ import annotations

import html
import os
import shutil
import tempfile
import threading
import webbrowser
from contextlib import suppress
from pathlib import Path

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0;url={url}">
<title>Nisus</title>
<a href="{url}">Open Nisus</a>
</html>
"""


class Opening:
    """A file that leads to the page, in a folder of its own, until it has been used."""

    def __init__(self, url: str) -> None:
        """Write the file.

        Raises:
            OSError: If no folder for it can be made.
        """
        # The runtime folder is the user's own, and is emptied when they log out, should this process be killed.
        root = os.environ.get("XDG_RUNTIME_DIR")
        usable = root is not None and os.access(root, os.W_OK | os.X_OK)
        # Made for this user only, as mkdtemp does; the file is too, whatever the umask says.
        self._folder = Path(tempfile.mkdtemp(prefix="nisus-", dir=root if usable else None))
        self.path = self._folder / "open.html"
        handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(PAGE.format(url=html.escape(url)))

    def show(self) -> None:
        """Start the browser, in a thread: one in the terminal does not return before it is left."""
        threading.Thread(target=webbrowser.open, args=(self.path.as_uri(),), daemon=True).start()

    def close(self) -> None:
        """Remove the file."""
        with suppress(OSError):
            shutil.rmtree(self._folder)
