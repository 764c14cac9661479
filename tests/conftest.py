"""What tests share: recordings and browser, which a machine may lack, but not the one that judges (CI=true)."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


def absent(reason: str) -> None:
    """Skip, and say why; under CI=true fail instead, so that a green run has tested everything."""
    if os.environ.get("CI", "").lower() in ("true", "1"):
        pytest.fail(f"{reason}; with CI=true that is a failure", pytrace=False)
    pytest.skip(reason)


def data_folder() -> Path:
    """Where recordings lie: NISUS_DATA, or beside the checkout."""
    return Path(os.environ.get("NISUS_DATA") or ROOT.parent / "shared" / "data")


@pytest.fixture(scope="session")
def data() -> Callable[..., Path]:
    """data("set", "file"): a recording; the test skips where it is absent."""

    def find(*parts: str) -> Path:
        path = data_folder().joinpath(*parts)
        if not path.exists():
            absent(f"recording {'/'.join(parts)} is not in {data_folder()}; set NISUS_DATA to the folder that has it")
        return path

    return find


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of a Chromium; the test skips where there is none."""
    given = os.environ.get("NISUS_CHROMIUM")
    found = given or next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if not found or not Path(found).exists():
        absent("no Chromium found; install one (Debian: apt install chromium) or set NISUS_CHROMIUM to its path")
    return str(found)
