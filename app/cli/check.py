"""`nisus check`: undetectable faults, observability and consistency of a twin, on one page."""

from __future__ import annotations

from config.yaml_files import writing

from ..render.html import to_html
from ..render.text import to_text
from ..result import to_json
from ..study.check import Checked, check, figures, topics
from ..study.checklist import checklist
from ..study.processes import executor_of
from ..twin.log_reader import read_log
from ..twin.twin import with_held
from .arguments import CheckCommand as Arguments
from .prepare import attend, overrides_of, prepared


def check_twin(arguments: Arguments) -> int:
    """Fold the log of a twin, and print the result of its check."""
    twin = prepared(arguments)
    log, counts = read_log(twin, arguments.duration)
    with executor_of(arguments.cluster, twin, with_held(twin), arguments.twin, overrides_of(arguments)) as executor:
        checked: Checked = attend(twin.model, lambda: check(twin, log, counts, executor=executor), "checking")
    lines = checklist(checked)
    parts = topics(checked, lines)
    if arguments.html is not None:
        with writing(arguments.html, "--html"):
            arguments.html.write_text(to_html(f"nisus check {twin.name}", parts), encoding="utf-8")
    print(to_json(figures(checked, lines)) if arguments.json else to_text(parts))
    return 0
