"""Episodes as `nisus fold` prints them: the first ones, in their order, with who is to blame, and how many more."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from estimators.diagnostics.episodes import Episode, episode_json
from estimators.diagnostics.sensitivity.suspects import RIDDLES, Suspect, in_words, likeliest, suspects
from estimators.errors import NisusError
from estimators.fold import Fold
from estimators.log import READING
from sources.source import WRONG_TIME

SHOWN = 10

ASKED = 3
"""Episodes whose cause is looked for, the first ones: each takes a refold for every sensor, input and parameter."""


class Told(NamedTuple):
    """An episode, and the faults that explain it best."""

    episode: Episode
    suspects: tuple[Suspect, ...]


MANY = 0.05
"""Share of readings that never came into the log from which nothing that it says is to be trusted."""


def dropped(counts: Mapping[str, int], fold: Fold) -> list[Episode]:
    """An episode of what was dropped before the log, if that was much."""
    lost = counts.get("stale", 0) + counts.get(WRONG_TIME, 0)
    kept = int(np.sum(fold.log.kind[: fold.n] == READING))
    share = lost / max(1, lost + kept)
    if share < MANY:
        return []
    t = fold.log.t[: fold.n] * 1e-9
    text = (
        f"{100 * share:.3g} % of the readings were dropped, {lost} of {lost + kept}: too late, or with a time that "
        "cannot be true; check the times of the source, or lengthen time.horizon"
    )
    return [Episode(float(t[0]), None, "twin", "dropped", share, math.nan, math.nan, "", text)]


def blamed(fold: Fold, episodes: Sequence[Episode]) -> list[Told]:
    """The episodes, the first of those in which readings are shifted with whoever may be to blame."""
    told: list[Told] = []
    asked = 0
    for episode in episodes:
        found: tuple[Suspect, ...] = ()
        if episode.cause in RIDDLES and asked < ASKED:
            asked += 1
            found = _suspects(fold, episode)
        told.append(Told(episode, found))
    return told


def _suspects(fold: Fold, episode: Episode) -> tuple[Suspect, ...]:
    try:
        return likeliest(suspects(fold.estimator.name, fold.model, fold.tuning, fold.log, episode.start))
    except NisusError:
        return ()


def as_json(told: Told) -> dict[str, Any]:
    """An episode for JSON, with its suspects."""
    return {
        **episode_json(told.episode),
        "suspects": [
            {
                "kind": suspect.nudge.kind,
                "name": suspect.nudge.name,
                "size": suspect.size,
                "deviation": suspect.deviation,
                "unit": suspect.nudge.unit,
                "log_likelihood": suspect.gain,
            }
            for suspect in told.suspects
        ],
    }


def episode_lines(told: Sequence[Told]) -> Iterator[str]:
    """A heading and a line each; a word where there are none."""
    if not told:
        yield "no episodes: nothing that the tests could see was wrong"
        return
    yield f"{len(told)} episode(s); docs/alarms.md says what each cause means"
    for episode, found in told[:SHOWN]:
        lasted = "at the end" if episode.end is None else f"for {episode.end - episode.start:.3g} s"
        yield f"  {episode.cause}, {lasted}: {episode.text}"
        if found:
            yield f"    most likely off: {in_words(found)}"
    if len(told) > SHOWN:
        yield f"  and {len(told) - SHOWN} more; --json has them all"
