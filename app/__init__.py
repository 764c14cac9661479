"""The running twin: engine, views, page server, recorder, command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal

from sources import formats


def _added(kind: Literal["tables", "folders"]) -> Mapping[str, Callable[[], object]]:
    from config.extensions import maker, registered

    return {name: partial(maker, kind, name) for name in registered(kind)}


formats.added = _added
