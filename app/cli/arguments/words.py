"""Kinds of words that several commands take."""

from __future__ import annotations

from typing import Annotated

import tyro

Twin = Annotated[str, tyro.conf.Positional]
Settings = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
Files = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
