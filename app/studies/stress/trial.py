"""One mistake made with one filter over one log: what was said of it, and what the estimate was worth meanwhile."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from estimators.diagnostics.episodes import episodes
from estimators.diagnostics.score import Score, score

from .bench import Bench, Folded
from .foretold import VISIBLE, Foretold
from .mistake import Mistake
from .told import accused, first_word, green_share, heard_in, recovery, said_at

GATE = 0.9973
"""Of the fold with the defence, where the twin ships without a gate."""


OUTCOMES = NAMED, MISNAMED, MISSED, UNSEEN, RIGHTLY_SILENT, FALSE = (
    "named",
    "misnamed",
    "MISSED",
    "unseen",
    "rightly silent",
    "false alarm",
)
"""Of a mistake: found, by its name or by another; not found though it was visible: wrong and green; not found as
foretold, or by chance. Of what is none: not heard of, heard of."""


@dataclass(frozen=True)
class Trial:
    """What came of one mistake.

    `foretold`: visible, invisible or by chance, before it was made; `visible_from`: the multiple of its size from which
    on it would be visible, NaN where that is not known. `outcome`: one of `OUTCOMES`. `delay`: seconds from its start
    to the first episode with its cause and one of its subjects; `word`: to the first row that is not green; None is
    never. `named`: the first episode after the start, subject and cause; `accused`: whom it tells a user to look at,
    once all has been seen until the mistake's end. What is heard of without the mistake, too, does not count. `early`:
    episodes that were heard of before it began. `green`: share of green rows while it lasted. `error` and `bare`: RMSE
    by state over the truth meanwhile, with a gate and without; `calm`: of the same filter over the same time, without
    the mistake; `coverage`: share of the truth in the 95 % band, by state. `recovery`: seconds from its end until green
    for good; None is never, or that it does not end.
    """

    mistake: str
    estimator: str
    seed: int
    start: float
    end: float
    foretold: str
    visible_from: float
    outcome: str
    delay: float | None
    word: float | None
    named: str | None
    accused: str | None
    cause_right: bool
    subject_right: bool
    early: int
    green: float
    error: dict[str, float]
    bare: dict[str, float]
    calm: dict[str, float]
    coverage: dict[str, float]
    recovery: float | None
    stale: int


def make(bench: Bench, mistake: Mistake, estimator: str, foretold: Foretold) -> Trial:
    """Make a mistake with a filter, of which it was told before what would be seen.

    Raises:
        NisusError: If the filter does not apply, or the mistake cannot be made.
    """
    gate = bench.twin.tuning.gate
    gated, bare = bench.fold(mistake, estimator, gate or GATE), bench.fold(mistake, estimator, None)
    ships = gated if gate is not None else bare
    shipped = ships.fold
    start, end = bench.window(mistake)
    begun, ended = bench.span(mistake)
    undisturbed = bench.fold(None, estimator, gate)
    told = heard_in(shipped, undisturbed.fold)
    since = [(at, item) for at, item in told if at >= begun]
    after = [(at, item) for at, item in since if at < ended]
    blamed = cache(lambda item: accused(shipped, item, ended))
    fits = (at for at, item in after if mistake.right_cause(item) and mistake.right_subject(blamed(item)))
    fit = next(fits, None)
    # That the estimate is lost is no cause, and is said sooner than one can be told.
    first = next((item for _, item in after if item.cause != "diverged"), after[0][1] if after else None)
    word = first_word(shipped, begun, undisturbed.fold)
    heard = word is not None and word < (ended - begun) / 1e9
    scores = {name: _score(item, begun, ended) for name, item in (("gated", gated), ("bare", bare))}
    calm = _score(undisturbed, begun, ended)
    return Trial(
        mistake=mistake.name,
        estimator=estimator,
        seed=bench.seed,
        start=start,
        end=end,
        foretold=foretold.verdict,
        visible_from=foretold.multiple,
        outcome=_outcome(mistake, foretold.verdict, heard, fit is not None),
        delay=(fit - begun) / 1e9 if fit is not None else None,
        word=word,
        named=f"{first.subject} {first.cause}" if first is not None else None,
        accused=blamed(first) if first is not None else None,
        cause_right=first is not None and mistake.right_cause(first),
        subject_right=first is not None and mistake.right_subject(blamed(first)),
        early=sum(said_at(undisturbed.fold, item) < begun for item in episodes(undisturbed.fold)),
        green=green_share(shipped, begun, ended),
        error={name: fit.rmse for name, fit in scores["gated"].states.items()},
        bare={name: fit.rmse for name, fit in scores["bare"].states.items()},
        calm={name: fit.rmse for name, fit in calm.states.items()},
        coverage={name: fit.coverage for name, fit in scores["gated" if ships is gated else "bare"].states.items()},
        recovery=None if mistake.fault is None else recovery(shipped, ended),
        stale=ships.stale,
    )


def _outcome(mistake: Mistake, foretold: str, heard: bool, named: bool) -> str:
    if not mistake.causes:
        return FALSE if heard else RIGHTLY_SILENT
    if not heard:
        return MISSED if foretold == VISIBLE else UNSEEN
    return NAMED if named else MISNAMED


def _score(folded: Folded, start: int, end: int) -> Score:
    t = folded.truth.t
    rows = (t >= start) & (t <= end)
    track = folded.fold.track.select(slice(0, t.size)).select(rows)
    return score(track, folded.truth.select(rows), folded.fold.model)
