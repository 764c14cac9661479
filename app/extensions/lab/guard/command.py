"""`nisus guard`: fold archived recordings with accepted tunings and compare their figures with the baseline."""

from __future__ import annotations

import os

from app.cli.options import check_output, overrides_of
from app.cli.prepare import progress
from app.render.text import to_text
from app.result import to_json
from config.yaml_files import writing
from estimators.errors import ConfigError, printable

from ..arguments import GuardCommand as Arguments
from .suite import chosen, guard_all, guard_json, guard_topics, junit, keep_last


def guard(arguments: Arguments) -> int:
    """Run the command; return 0 if nothing got worse, 1 if something did, 2 if something failed."""
    if arguments.accept and not arguments.note.strip():
        raise ConfigError("--accept: give the reason with --note TEXT; it is saved with the baseline")
    if arguments.junit is not None:
        check_output("--junit", arguments.junit)
    logs = chosen(arguments.twins, arguments.archive)
    note = printable(arguments.note).strip() if arguments.accept else None
    with progress("guard", len(logs), "recordings") as advance:
        found = guard_all(logs, note, overrides_of(arguments), advance, jobs=arguments.jobs, cluster=arguments.cluster)
    absent_fails = os.environ.get("CI", "").lower() in ("true", "1")
    if not arguments.set:
        for twin in dict.fromkeys(each.twin for each in logs):
            keep_last(twin, [one for each, one in zip(logs, found, strict=True) if each.twin == twin])
    if arguments.junit is not None:
        with writing(arguments.junit, "--junit"):
            arguments.junit.write_bytes(junit(found, absent_fails=absent_fails))
    print(to_json(guard_json(found)) if arguments.json else to_text(guard_topics(found, absent_fails)))
    if any(each.failure or (each.absent and absent_fails) for each in found):
        return 2
    return 0 if arguments.accept else int(any(figure.worse for each in found for figure in each.compared))
