"""`nisus check`: what could be wrong with a twin unnoticed, and what its estimate is worth, on one page."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from config.yaml_files import writing

from ..present.result import to_html, to_text
from ..twin.log_reader import read_log
from ..twin.twin import load_twin
from .check_figures import figures
from .check_tables import sections
from .checked import Checked, check
from .options import settings
from .prepare import attend, prepare

if TYPE_CHECKING:
    from .arguments import Check as Arguments


def check_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    twin = load_twin(
        arguments.twin,
        log_files=arguments.log or None,
        overrides=settings(arguments.set, arguments.estimator, arguments.tuning),
    )
    prepare(twin)
    log, counts = read_log(twin, arguments.duration)
    checked: Checked = attend(twin.model, lambda: check(twin, log, counts), "checking")
    parts = sections(checked)
    if arguments.html is not None:
        with writing(arguments.html, "--html"):
            arguments.html.write_text(to_html(f"nisus check {twin.name}", parts), encoding="utf-8")
    if arguments.json:
        print(json.dumps(figures(checked), allow_nan=False))
    else:
        print("\n".join(to_text(parts)))
    return 0
