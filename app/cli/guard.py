"""`nisus guard`: archived recordings folded with their accepted tunings, and compared with their recorded scores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numba

from config.files import writing
from estimators.errors import ConfigError, printable

from ..present.result import Topic, to_text
from ..studies.guard.archive import Archived, Wanted, chosen, guarded
from ..studies.guard.baseline import Guarded, junit, keep_last
from ..studies.processes import beside, jobs_of
from .options import check_place, settings
from .progress import progress

if TYPE_CHECKING:
    from .arguments import Guard as Arguments


def guard(arguments: Arguments) -> int:
    """Carry the command out: 0 if nothing is worse than recorded, 1 if something is, 2 if something failed."""
    if arguments.accept and not arguments.note.strip():
        raise ConfigError("--accept: say why with --note TEXT; it is kept with the scores")
    if arguments.junit is not None:
        check_place("--junit", arguments.junit)
    archive = chosen(arguments.twins, arguments.archive)
    note = printable(arguments.note).strip() if arguments.accept else None
    found = _all(archive, Wanted(note, settings(arguments.set)), arguments.jobs)
    must = os.environ.get("CI", "").lower() in ("true", "1")
    if not arguments.set:
        for twin in dict.fromkeys(each.twin for each in archive):
            keep_last(twin, [one for each, one in zip(archive, found, strict=True) if each.twin == twin])
    if arguments.junit is not None:
        with writing(arguments.junit, "--junit"):
            arguments.junit.write_bytes(junit(found, absent_fails=must))
    print("\n".join(to_text(_parts(found, must))))
    if any(each.failure or (each.absent and must) for each in found):
        return 2
    return 0 if arguments.accept else int(any(judged.worse for each in found for judged in each.judged))


def _all(archive: Sequence[Archived], wanted: Wanted, jobs: int | None) -> list[Guarded]:
    jobs = jobs_of(jobs, len(archive))
    with progress("guard", len(archive), "recordings") as advance:
        if jobs == 1:
            found = []
            for archived in archive:
                found.append(guarded(archived, wanted))
                advance()
            return found
        calls = [(archived, wanted) for archived in archive]
        with beside(guarded, calls, jobs, numba.set_num_threads, (1,)) as futures:
            for future in futures:
                future.add_done_callback(lambda _: advance())
            return [future.result() for future in futures]


def _parts(found: Sequence[Guarded], must: bool) -> list[Topic]:
    """What got worse, what could not be folded, what is absent, and the sum."""
    worse = [(each, judged) for each in found for judged in each.judged if judged.worse]
    better = [(each, judged) for each in found for judged in each.judged if judged.better]
    folded = [each for each in found if not each.failure and not each.absent]
    failures = [f"{each.name}: {each.failure}" for each in found if each.failure]
    absent = [f"{each.name}: {each.absent}" for each in found if each.absent]
    figures = sum(len(each.judged) for each in found)
    said = [f"{len(folded)} recordings, {figures} figures: {len(worse)} worse, {len(better)} better"]
    if better and not worse:
        said.append("What got better is guarded once it is recorded: --accept --note ...")
    parts = [Topic("Guard", tuple(said))]
    for title, some in (("Worse than recorded", worse), ("Better than recorded", better)):
        if some:
            head = ("recording", "tuning", "figure", "was", "is", "change", "allowed")
            rows = tuple(
                (
                    each.name,
                    each.version,
                    judged.figure if not judged.log else f"{judged.figure} (log {judged.log})",
                    f"{judged.before:.6g}",
                    f"{judged.now:.6g}",
                    f"{judged.change:+.3g}",
                    f"{judged.allowed:.2g}",
                )
                for each, judged in some
            )
            parts.append(Topic(title, (), head, rows))
    if failures:
        parts.append(Topic("Could not be folded", tuple(failures)))
    if absent:
        title = "Absent, which CI=true makes an error" if must else "Absent, and left out"
        parts.append(Topic(title, tuple(absent)))
    return parts
