"""`nisus commission`: what is normal of a twin whose tuning is accepted, as lines of its YAML."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from estimators.diagnostics.commission import Normal, commission
from estimators.errors import ConfigError
from estimators.fold import Fold

from ..engine.stall import interruptible
from ..twin.twin import load_twin
from .arguments import settings
from .fold import read_log
from .prepare import prepare

if TYPE_CHECKING:
    from .arguments import Commission as Arguments

SECTION = re.compile(r"^commissioned:.*(?:\n|\Z)(?:(?:[ \t]*(?:#.*)?\r?\n)*[ \t]+[^\s#].*(?:\n|\Z))*", re.MULTILINE)
"""The section in a YAML: its key and the lines under it, to the last that is indented; a comment after that belongs to
what follows."""


def commission_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    twin = load_twin(
        arguments.twin, log_files=arguments.log or None, overrides=settings(arguments.set, arguments.estimator)
    )
    prepare(twin)
    log, _ = read_log(twin, arguments.duration)
    # What is normal is told from white innovations, not from what was normal before.
    fold = Fold(twin.estimator, twin.model, replace(twin.tuning, baseline=None), log, policy=twin.policy)
    interruptible(fold, fold.advance)
    text = lines(commission(fold, fold.evidence))
    if not arguments.write:
        print(text, end="")
        return 0
    write(twin.path, text)
    print(f"{twin.path}: commissioned on {log.n} events of {twin.name}, {twin.estimator}")
    return 0


def lines(normals: Mapping[str, Normal]) -> str:
    """The section of the YAML.

    Raises:
        ConfigError: If no row has enough readings.
    """
    if not normals:
        raise ConfigError("no sensor row has 50 readings that were judged; commission on a longer recording")
    text = "commissioned:                    # what was normal when this tuning was accepted (nisus commission)\n"
    for name, normal in normals.items():
        reached = ", ".join(f"{cause}: {peak:g}" for cause, peak in normal.reached.items())
        text += f"  {name}: {{bias: {normal.bias:g}, scale: {normal.scale:g}, correlation: {normal.correlation:g},\n"
        text += f"    reached: {{{reached}}}}}\n"
    return text


def write(path: Path, section: str) -> None:
    """Put the section into a YAML file, in place of the one that is there, or at its end.

    Raises:
        ConfigError: If the file cannot be written.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            text = file.read()
        end = "\r\n" if "\r\n" in text else "\n"
        section = section.replace("\n", end)
        kept, found = SECTION.subn(lambda _: section, text, count=1)
        path.write_text(kept if found else text.rstrip("\r\n") + 2 * end + section, encoding="utf-8", newline="")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror})") from None
