"""Episodes as `nisus fold` prints them: the first ones, in their order, and how many more there are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from estimators.diagnostics.episodes import Episode

SHOWN = 10


def episode_lines(episodes: Sequence[Episode]) -> Iterator[str]:
    """A heading and a line each; a word where there are none."""
    if not episodes:
        yield "no episodes: nothing that the tests could see was wrong"
        return
    yield f"{len(episodes)} episode(s); ALARMS.md says what each cause means"
    for episode in episodes[:SHOWN]:
        lasted = "at the end" if episode.end is None else f"for {episode.end - episode.start:.3g} s"
        yield f"  {episode.cause}, {lasted}: {episode.text}"
    if len(episodes) > SHOWN:
        yield f"  and {len(episodes) - SHOWN} more; --json has them all"
