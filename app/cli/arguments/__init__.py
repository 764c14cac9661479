"""What can be asked on the command line: a dataclass for each command."""

from __future__ import annotations

from typing import get_args

from .folding import Advise, Check, Compare, Fold, Stress
from .listing import Filters, Log, New, Schema, Twins
from .running import Bus, Review, Run
from .tuned import Commission, Guard, Learn, Tune, Tunings

__all__ = [
    "COMMANDS",
    "Advise",
    "Bus",
    "Check",
    "Command",
    "Commission",
    "Compare",
    "Filters",
    "Fold",
    "Guard",
    "Learn",
    "Log",
    "New",
    "Review",
    "Run",
    "Schema",
    "Stress",
    "Tune",
    "Tunings",
    "Twins",
]

Command = (
    Run
    | Fold
    | Check
    | Advise
    | Compare
    | Tune
    | Learn
    | Guard
    | Stress
    | Commission
    | Filters
    | Review
    | Bus
    | Twins
    | Tunings
    | Schema
    | Log
    | New
)
COMMANDS: dict[str, type] = {command.__name__.lower(): command for command in get_args(Command)}
