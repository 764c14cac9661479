"""The Rerun web viewer's files, taken from the installed rerun-sdk and kept in the user's cache.

The wheel holds the viewer only inside its `rerun` program. That program is run once, on loopback ports and with a home
folder of its own: it would else write an analytics identity into the user's, and later call home with it.
"""

from __future__ import annotations

import gzip
import importlib.util
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from estimators.compiled.orphan import killed_with_parent
from estimators.errors import ConfigError

FILES = ("re_viewer.js", "re_viewer_bg.wasm")
VIEWER_TIMEOUT_S = 60.0
"""Longest wait for the program; it is large, and its first start reads it all from disk."""


def viewer_version() -> str:
    """Return the version of the installed rerun-sdk, which the viewer must match."""
    return version("rerun-sdk")


def viewer_assets(progress: Callable[[str], None] = lambda line: None) -> Path:
    """Return the folder of the viewer's files, each compressed (`NAME.gz`); they are made if absent.

    `progress` is called with a line of text when that takes time.

    Raises:
        ConfigError: If the files cannot be made or written.
    """
    root = os.environ.get("XDG_CACHE_HOME")
    folder = (Path(root) if root else Path.home() / ".cache") / "nisus" / f"rerun-{viewer_version()}"
    if all((folder / f"{name}.gz").is_file() for name in FILES):
        return folder
    progress(f"preparing the Rerun {viewer_version()} viewer, once")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="nisus-rerun-") as home:
            for name, content in _served_files(Path(home)).items():
                # Under another name first: a second Nisus must never see half a file.
                part = folder / f".{name}.{os.getpid()}"
                part.write_bytes(gzip.compress(content, 6, mtime=0))
                part.replace(folder / f"{name}.gz")
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"{folder}: {reason}; set XDG_CACHE_HOME to a folder that can be written") from None
    return folder


def _program() -> Path:
    found = importlib.util.find_spec("rerun_cli")
    folder = Path(next(iter(found.submodule_search_locations or [""]))) if found is not None else Path()
    choices = [folder / "rerun", folder / "rerun.exe", folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"]
    for path in choices:
        if path.is_file():
            return path
    raise ConfigError("rerun-sdk: its viewer program is missing; pip install --force-reinstall rerun-sdk")


def _served_files(home: Path) -> dict[str, bytes]:
    """Run the program's web server and fetch its files."""
    analytics = home / ".config" / "rerun" / "analytics.json"
    analytics.parent.mkdir(parents=True)
    analytics.write_text(json.dumps({"analytics_enabled": False, "analytics_id": "", "metadata": {}}))
    settings = {
        **os.environ,
        **dict.fromkeys(("HOME", "USERPROFILE", "APPDATA", "LOCALAPPDATA"), str(home)),
        **{f"XDG_{name}_HOME": str(home / f".{name.lower()}") for name in ("CONFIG", "DATA", "CACHE")},
        # `--serve-web` would open the user's browser.
        "BROWSER": "true" if sys.platform != "win32" else "",
        "DISPLAY": "",
        "WAYLAND_DISPLAY": "",
    }
    grpc_port, web_port = _free_port(), _free_port()
    ports = ["--bind", "127.0.0.1", "--port", str(grpc_port), "--web-viewer-port", str(web_port)]
    with (home / "log").open("wb") as log:
        process = subprocess.Popen(
            [str(_program()), "--serve-web", *ports],
            stdout=log,
            stderr=log,
            stdin=subprocess.DEVNULL,
            env=settings,
            preexec_fn=killed_with_parent,
        )
        try:
            return {name: _fetch(f"http://127.0.0.1:{web_port}/{name}", process, home / "log") for name in FILES}
        finally:
            process.kill()
            process.wait()


def _fetch(url: str, process: subprocess.Popen[bytes], log: Path) -> bytes:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    end = time.monotonic() + VIEWER_TIMEOUT_S
    while True:
        try:
            with opener.open(url, timeout=VIEWER_TIMEOUT_S) as answer:
                return bytes(answer.read())
        except (urllib.error.URLError, OSError) as error:
            if process.poll() is None and time.monotonic() < end:
                time.sleep(0.1)
                continue
            said = log.read_text(errors="replace").strip().splitlines()
            raise ConfigError(
                f"rerun-sdk {viewer_version()}: its viewer did not start ({said[-1] if said else error}); "
                "check that `rerun --version` runs"
            ) from None


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
