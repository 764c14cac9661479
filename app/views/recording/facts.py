"""What a recording is, in a few words, without reading its values: for lists of many."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from estimators.errors import SourceError


@dataclass(frozen=True)
class Facts:
    """Twin, filter, seconds from the first event to the last, and what it was worth (see summary.py), if it says so."""

    twin: str
    estimator: str | None
    seconds: float
    summary: dict[str, Any]


def facts_of(path: Path) -> Facts:
    """Look through a recording.

    Raises:
        SourceError: If it cannot be read, or is none of Nisus.
    """
    twin, estimator, summary = "", None, {}
    first, last = None, None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a killed writer leaves no footer
            reader = RrdReader(str(path))
        for chunk in reader.stream():
            part = chunk.entity_path.removeprefix("/nisus/")
            if part == chunk.entity_path or part not in ("twin", "tuning", "events", "summary"):
                continue
            batch = chunk.to_record_batch()
            names = {name: k for k, name in enumerate(batch.schema.names)}
            if part == "twin":
                twin = str(_values(batch, names["name"])[0])
            elif part == "tuning":
                estimator = json.loads(_values(batch, names["json"])[-1])["estimator"]
            elif part == "summary":
                summary = json.loads(_values(batch, names["json"])[-1])
            else:
                t = _values(batch, names["t"])
                # A late reading makes a recorder write events again, so they are not in the order of time.
                first = int(t.min()) if first is None else min(first, int(t.min()))
                last = int(t.max()) if last is None else max(last, int(t.max()))
    except Exception as error:  # noqa: BLE001  whatever Rerun raises of a file that is none
        if not twin:
            raise SourceError(f"{path.name}: it cannot be read; is it an .rrd file?") from error
    if not twin:
        raise SourceError(f"{path.name}: it is no recording of Nisus")
    return Facts(twin, estimator, 0.0 if first is None or last is None else (last - first) * 1e-9, summary)


def _values(batch: Any, k: int) -> Any:
    return batch.column(k).flatten().to_numpy(zero_copy_only=False)
