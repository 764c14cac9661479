"""What `nisus guard` said last of a twin's recordings, kept beside its tuning versions for whoever looks at those."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from config.tunings import folders

from ...live.tunings.versions import now
from .junit import Guarded, in_words

FILE = "guard.json"
"""Name of the file, in the folder of the versions."""


def keep_last(twin: Path, found: Sequence[Guarded]) -> None:
    """Keep what became of recordings of a twin; what was said of its other recordings stays.

    A folder that cannot be written to is no reason for a verdict to fail, and is passed over.
    """
    path = folders(twin)[0] / FILE
    said = {each["recording"]: each for each in last(twin)}
    said |= {each.name: _said(each) for each in found}
    text = json.dumps({"recordings": list(said.values())}, indent=1)
    other = path.with_name(f".{FILE}.{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        other.write_text(text, encoding="utf-8")
        other.replace(path)


def last(twin: Path) -> list[dict[str, Any]]:
    """What was said last of each recording of a twin, the newest first; nothing if nothing was, or it cannot be read.

    Each has `recording`, `at` (UTC), `version` (tuning), `figures` (how many), `worse` and `better` (a line each) and
    `failure`, empty unless it could not be folded.
    """
    try:
        found = json.loads((folders(twin)[0] / FILE).read_text(encoding="utf-8"))["recordings"]
        return sorted(found, key=lambda each: (each["at"], each["recording"]), reverse=True)
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _said(each: Guarded) -> dict[str, Any]:
    return {
        "recording": each.name,
        "at": now(),
        "version": each.version,
        "figures": len(each.judged),
        "worse": [in_words(judged) for judged in each.judged if judged.worse],
        "better": [f"{j.figure} was {j.before:.6g} and is {j.now:.6g}" for j in each.judged if j.better],
        "failure": each.failure,
    }
