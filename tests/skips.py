"""Skips for what a machine may lack: recordings, browser, broker, proxy, compiler. With CI=true they are failures."""

import os
import shutil
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import pytest

MISSING = {
    "recordings": "recordings are not here (see docs/recordings.md)",
    "Chromium": "Chromium is not here (Debian: apt install chromium-headless-shell; or NISUS_CHROMIUM=path)",
    "mosquitto": "mosquitto is not here (Debian: apt install mosquitto)",
    "nginx": "nginx is not here (Debian: apt install nginx-light)",
    "compiler": "a C compiler is not here (Debian: apt install gcc libc6-dev)",
}
"""What may be missing, and how the summary of a run says it."""

PROGRAMS = {"mosquitto": "mosquitto", "nginx": "nginx", "compiler": "cc"}


def skip_without(missing: str) -> NoReturn:
    """Skip the running test; under CI=true fail it, so that a green run has tested everything."""
    reason = MISSING[missing]
    if os.environ.get("CI", "").lower() in ("true", "1"):
        pytest.fail(f"{reason}; with CI=true that is a failure", pytrace=False)
    pytest.skip(reason)


def find_program(name: str) -> str | None:
    """Return the path of one of `PROGRAMS`; None if there is none."""
    path = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/usr/local/sbin"))
    return shutil.which(PROGRAMS[name], path=path)


def program(name: str) -> str:
    """Return the path of one of `PROGRAMS`; skip the test if there is none."""
    return find_program(name) or skip_without(name)


def data_folder() -> Path:
    """Return the folder of recordings: NISUS_DATA, else that of `nisus data get`."""
    from app.twin.sources.kind import recordings_folder

    return recordings_folder()


def recording(*parts: str) -> Path:
    """Return a file or folder of the recordings; skip the test where it is absent."""
    path = data_folder().joinpath(*parts)
    return path if path.exists() else skip_without("recordings")


def recorded(name: Any, duration: float | None = None, **options: Any) -> tuple[Any, Any]:
    """Return a twin by name or path and its own log, or what it has of it in seconds; see `with_recording`."""
    from app.twin.log_reader import read_log

    twin = with_recording(name, **options)
    return twin, read_log(twin, duration)[0]


def with_recording(name: Any, **options: Any) -> Any:
    """Return a twin, loaded with options of `load_twin`; skip the test where its recording is absent."""
    from app.twin.source import missing
    from app.twin.twin import load_twin

    twin = load_twin(name, **options)
    if missing(twin.plan.loaded) is not None:
        skip_without("recordings")
    return twin


def summary(reasons: Iterable[str]) -> list[str]:
    """Return one line for each reason of a skip: how many tests, and why."""
    counts = Counter(reasons)
    return [f"{n} {'test' if n == 1 else 'tests'} skipped: {reason}" for reason, n in counts.most_common()]
