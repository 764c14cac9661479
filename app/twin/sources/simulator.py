"""Sources of type simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .asset import check_asset, make_asset
from .kind import Kind, Opening

if TYPE_CHECKING:
    from sources.source import Source


def _open(opening: Opening) -> Source:
    return make_asset(opening.loaded, opening.model, opening.section, opening.key)


SIMULATOR = Kind(
    _open,
    check=lambda loaded, model, section, key: check_asset(loaded, section, key, model),
    sections=lambda section, key: {},
    takes_log=False,
)
