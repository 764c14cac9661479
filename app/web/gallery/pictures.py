"""Where a twin's picture for the gallery is kept: those of twins that ship in a folder of their own."""

from __future__ import annotations

from pathlib import Path

from config.loader import TWINS

CARDS = TWINS.parent / "cards"
"""Folder of the pictures of the twins that ship."""


def picture_file(twin: Path) -> Path:
    """Where the picture of a twin's YAML is; it may be absent."""
    ships = twin.resolve().parent == TWINS.resolve()
    return CARDS / f"{twin.stem}.svg" if ships else twin.with_suffix(".svg")
