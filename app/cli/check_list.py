"""The checklist of a twin: eight questions, each with an answer, the figures behind it and what to do."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from config.source_schema import CanLogSection, CanSection, MergedSection
from estimators.diagnostics.calibration import LIMITS, Calibration
from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.sensitivity import Gramian, Sensitivity, gramian, sensitivity
from estimators.diagnostics.sensitivity.checklist import (
    MAX_PROCESSOR_SHARE,
    Arrivals,
    Dimension,
    Linearity,
    arrivals,
    dimension,
    linearity,
    spread_error,
)
from estimators.diagnostics.sensitivity.held_out import HeldOut, held_out
from estimators.diagnostics.sensitivity.posterior import FREQUENT_SHARE, Peaks, Tail, peaks, tails
from estimators.diagnostics.sensitivity.responses import digits
from estimators.fold import Fold
from estimators.log import MAINTENANCE, READING, Log
from estimators.registry import find_entry
from estimators.track import HEALTH_NAMES, Track

from ..studies.compare import timed
from ..studies.fold_result import calibration_of
from ..studies.scores import scores_file
from ..twin.twin import Twin

YES, PARTLY, NO, NONE = "yes", "partly", "no", "not told"

MAX_CORRELATION = 0.9  # correlation of two estimates from which on one takes the blame for the other
MAX_CONDITIONING = 1e8  # conditioning from which on the information of the worst direction is rounding
UNOBSERVED_SHARE = 0.9  # share of the prior deviation; a direction that keeps more is not observed

LINEARISES = ("ekf", "iekf", "sr_ekf", "filterpy_ekf", "pf_ekf")


class ChecklistLine(NamedTuple):
    """One question of the checklist: `answer` is yes, partly, no, or "not told"."""

    key: str
    question: str
    answer: str
    figures: str
    remedy: str


def checklist(checked: Checked) -> list[ChecklistLine]:
    """The lines, in the order of the article."""
    return [
        _linearity(checked),
        _dimension(checked),
        _posterior(checked),
        _observability(checked),
        _timing(checked),
        _health(checked),
        _tuning(checked),
        _change(checked),
    ]


def _linearity(checked: Checked) -> ChecklistLine:
    found, name = checked.linearity, checked.twin.estimator
    question = "Does a linearised model pass innovation whiteness over what the log covers?"
    if found.passes is None:
        return ChecklistLine("linearity", question, NONE, found.reason, "")
    remedy = ""
    if not found.passes:
        better = (
            "ukf or ckf see the curvature" if name in LINEARISES else f"{name}, which runs here, does not linearise"
        )
        remedy = better
    elif not found.white:
        remedy = "correlation above zero: more Q, or a state is missing; below: less Q"
    answer = NO if not found.passes else YES if found.white else PARTLY
    return ChecklistLine("linearity", question, answer, found.text, remedy)


def _dimension(checked: Checked) -> ChecklistLine:
    found, fold = checked.dimension, checked.fold
    entry = fold.estimator
    question = "Is n small enough for O(n³) at this rate, or is an ensemble required?"
    figures = (
        f"{found.nx:,} states, {found.rate:.3g} readings a second; a covariance step is {digits(found.flops)} "
        f"operations on {scaled(found.memory, 'B')}; {entry.name} takes {scaled(found.seconds, 's')} a reading, "
        f"{100 * found.share:.2g} % of one processor"
    )
    if np.isfinite(found.largest) and found.largest > found.nx:
        figures += f" (growing with n³, all of it at {found.largest:,.0f} states)"
    members = fold.options.get("members", fold.options.get("particles", 0.0))
    if members:
        figures += f"; {members:,.0f} members: each σ is off by {100 * spread_error(members):.2g} % by chance"
    else:
        figures += f"; an ensemble would need {found.members} members for σ within 10 %"
    remedy = ""
    if found.share > MAX_PROCESSOR_SHARE:
        limit = f"{100 * MAX_PROCESSOR_SHARE:.0f} % of a processor"
        remedy = f"more than {limit}: fewer readings, fewer members, or another filter"
    elif entry.family == "ensemble":
        remedy = "an ensemble is what runs"
    answer = YES if found.passes and entry.family != "ensemble" else PARTLY if found.passes else NO
    return ChecklistLine("dimension", question, answer, figures, remedy)


def _posterior(checked: Checked) -> ChecklistLine:
    found = checked.peaks
    question = "Is the posterior multimodal, or is the noise heavy-tailed?"
    heavy = [tail for tail in checked.tails if tail.heavy]
    # Of many rows a few look so by chance.
    heavy = heavy if len(heavy) > FREQUENT_SHARE * len(checked.tails) else []
    if found.reason:
        said = [f"peaks are not computed: {found.reason}"]
    else:
        several = f"{100 * found.several:.2g} % of {found.looks} looks at the cloud of {found.estimator} over "
        several += f"{found.over:.4g} s show more than one peak (at most {found.most})"
        said = [several]
        if found.recoveries:
            said.append(f"the cloud was lost {found.recoveries} time(s), so its shape says little")
    worst = max(checked.tails, key=lambda tail: tail.kurtosis, default=None)
    if worst is not None:
        said.append(
            f"innovations: {sum(tail.heavy for tail in checked.tails)} of {len(checked.tails)} rows are heavy-tailed, "
            f"the worst {worst.row} with excess kurtosis {worst.kurtosis:.2g} and {100 * worst.far:.2g} % beyond 4 σ"
        )
    peaked = not found.reason and not found.recoveries and found.several > FREQUENT_SHARE
    remedy = ""
    if peaked:
        one = checked.fold.estimator.peaks is None
        remedy = (
            f"{checked.twin.estimator} has one peak: use pf, pf_ekf or rbpf" if one else "particles carry the peaks"
        )
    elif heavy and checked.linearity.passes is not None and not checked.linearity.white:
        remedy = "innovations are correlated too: these are errors of the model, and a gate would refuse good readings"
    elif heavy and checked.twin.tuning.gate is None:
        remedy = "heavy tails need a gate, not particles: set gate: 0.99999"
    elif heavy:
        remedy = "heavy tails: the gate takes the worst of them"
    answer = YES if peaked else PARTLY if heavy else NONE if found.reason and worst is None else NO
    return ChecklistLine("posterior", question, answer, "; ".join(said), remedy)


def scaled(value: float, unit: str) -> str:
    """A positive number to three digits with the prefix that fits: `29.8 µs`, `648 B`."""
    steps = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))
    factor, prefix = next((step for step in steps if value >= step[0]), (1e-9, "n"))
    return f"{value / factor:.3g} {prefix}{unit}"


def health_shares(track: Track) -> str:
    """Return the share of the track in each state of health, the largest first."""
    share = np.bincount(track.health, minlength=len(HEALTH_NAMES)) / max(1, len(track))
    return ", ".join(f"{HEALTH_NAMES[k]} {_percent(share[k])}" for k in np.argsort(-share, kind="stable") if share[k])


def _percent(share: float) -> str:
    """Format a share, as 0 % or 100 % only where it is exact."""
    if 0.0 < share < 0.0005:
        return "less than 0.1 %"
    return "more than 99.9 %" if 0.9995 <= share < 1.0 else f"{100 * share:.3g} %"


def _every(seconds: float) -> str:
    return "a day" if seconds == 86400.0 else f"in {seconds:g} s"


def blamed(found: Sensitivity) -> list[tuple[str, str, float]]:
    """Return pairs of nudges that the log hardly distinguishes.

    Their estimates would be correlated beyond 0.9 if these two were unknown and all others known.
    """
    names = [nudge.subject for nudge in found.nudges]
    root = np.sqrt(np.diag(found.fisher))
    with np.errstate(all="ignore"):
        c = -found.fisher / np.outer(root, root)
    pairs = [
        (names[i], names[j], float(c[i, j]))
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(c[i, j]) > MAX_CORRELATION
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


def _observability(checked: Checked) -> ChecklistLine:
    found, told = checked.gramian, checked.sensitivity
    question = "Is the Gramian well conditioned for every state and parameter that is estimated?"
    whole = found.whole
    if whole is None:
        return ChecklistLine("observability", question, NONE, found.reason, "")
    figures = (
        f"rank {whole.rank} of {checked.twin.model.nx}, conditioning {digits(whole.conditioning)}; "
        f"the weakest direction is {whole.text}"
    )
    if found.windows:
        ranks = [window.rank for window in found.windows]
        every = f"{min(ranks)}" if min(ranks) == max(ranks) else f"{min(ranks)} to {max(ranks)}"
        figures += f"; of {len(ranks)} parts of the log each alone gives rank {every}"
    pairs = blamed(told)
    if pairs:
        first, second, value = pairs[0]
        figures += f"; {len(pairs)} pair(s) look alike in the readings, most of all {first} and {second} ({value:+.2f})"
    if whole.beyond:
        return ChecklistLine("observability", question, NONE, f"{figures}; {found.note}", "")
    free = checked.twin.model.prior_std > 0.0
    left = whole.deviation[free]
    unseen = bool(left.size and left.max() > UNOBSERVED_SHARE)
    full = whole.rank >= int(free.sum()) and whole.conditioning < MAX_CONDITIONING
    remedy = ""
    if unseen or not full:
        remedy = "a state that is not observed keeps its prior and drifts: add a sensor, or rely on its band only"
    elif pairs:
        remedy = "do not estimate both of a pair from this log; measure one, or excite the asset otherwise"
    return ChecklistLine(
        "observability", question, NO if unseen else YES if full and not pairs else PARTLY, figures, remedy
    )


def stamps(checked: Checked) -> str:
    """Return the origin of the times of the measurements."""
    source = checked.twin.config.source
    kinds = {type(part) for part in source.parts} if isinstance(source, MergedSection) else {type(source)}
    if kinds & {CanSection, CanLogSection}:
        return "frames are stamped where they are received, not at the sensor"
    return "every reading has the time at which it was measured"


def _timing(checked: Checked) -> ChecklistLine:
    question = "Are there source timestamps, a buffer for the worst latency, and a policy for stale data?"
    section, policy = checked.twin.config.time, checked.twin.policy
    spoke = [item for item in checked.arrivals if item.n]
    late = [item for item in spoke if np.isfinite(item.lateness[-1])]
    silent = [item.sensor for item in checked.arrivals if not item.n]
    stale = checked.counts["stale"]
    said = [stamps(checked)]
    worst = max(spoke, key=lambda item: np.nan_to_num(item.gap), default=None)
    if worst is not None and np.isfinite(worst.gap):
        said.append(f"longest gap {worst.gap:.3g} s ({worst.sensor})")
    if late:
        most = max(item.lateness[-1] for item in late)
        said.append(f"worst lateness {most:.3g} s for a horizon of {section.horizon:g} s")
    else:
        said.append(f"when readings arrived is not known; the horizon is {section.horizon:g} s")
    said.append(f"{stale} stale; degraded after {policy.degraded_after:g} s, stale after {policy.stale_after:g} s")
    if silent:
        said.append(f"never heard: {', '.join(silent)}")
    remedy = ""
    if stale:
        remedy = f"{stale} reading(s) came later than the horizon: raise time.horizon"
    elif silent:
        remedy = "check the channel map of the sensors that never reported"
    elif worst is not None and worst.gap > policy.degraded_after:
        remedy = f"{worst.sensor} is silent for longer than {policy.degraded_after:g} s: degraded meanwhile"
    whole = bool(late) and "measured" in said[0] and not silent
    return ChecklistLine("timing", question, NO if stale else YES if whole else PARTLY, "; ".join(said), remedy)


def _health(checked: Checked) -> ChecklistLine:
    question = "Are NIS, whiteness and refusals monitored, with alerts and a documented response?"
    found = checked.episodes
    wrong = [entry for entry in checked.calibration if entry.words]
    rate = _every(checked.twin.policy.false_alarm_every)
    figures = (
        f"at most one false alarm {rate}; {health_shares(checked.fold.track)}; {len(found)} episode(s); "
        f"calibration off in {len(wrong)} of {len(checked.calibration)} rows and states"
    )
    remedy = found[0].text if found else wrong[0].words[0] if wrong else ""
    return ChecklistLine("health", question, YES, figures, remedy)


def _tuning(checked: Checked) -> ChecklistLine:
    question = "Are Q and R fitted on recorded data, versioned, and covered by regression tests?"
    twin = checked.twin
    kept = scores_file(twin.path)
    scores = kept.exists()
    off = [
        entry.subject
        for entry in checked.calibration
        if entry.role == "used" and entry.scale.beyond(1.0 / (1.0 + LIMITS.width), 1.0 + LIMITS.width)
    ]
    normal = "their baseline is kept with them" if twin.tuning.baseline is not None else "their baseline is not kept"
    figures = (
        f"Q and R stand in {twin.path.name}, which says no more of a fit than its comments; {normal}; scores of every "
        f"filter {'are kept in ' + kept.name if scores else 'are not kept'}; bands off by more than a quarter: "
        f"{', '.join(off[:4]) if off else 'none'}{f' and {len(off) - 4} more' if len(off) > 4 else ''}"
    )
    remedy = []
    if twin.tuning.baseline is None:
        remedy.append(f"nisus commission {twin.path.stem} keeps what is normal, so that a change is told")
    if not scores:
        remedy.append(f"nisus compare {twin.path.stem} --write keeps the scores")
    return ChecklistLine("tuning", question, PARTLY if scores or not remedy else NO, figures, "; ".join(remedy))


def _change(checked: Checked) -> ChecklistLine:
    question = "Is the model version tied to maintenance events?"
    log = checked.log
    done = int(np.sum(log.kind[: log.n] == MAINTENANCE))
    figures = f"each maintenance counts the version of {checked.twin.model.name} up; {done} in this log"
    remedy = "report maintenance to the twin, so that the covariance of the changed part is reset"
    return ChecklistLine("change", question, YES if done else PARTLY, figures, "" if done else remedy)


HELD_OUT_BUDGET_S = 20.0
"""Seconds of one processor for the folds with a sensor held out; of a log that takes longer the first part is taken."""


@dataclass(frozen=True)
class Checked:
    """All that was measured of a twin. `span` is the part of the log, from its start, that was folded, s; None: all."""

    twin: Twin
    log: Log
    fold: Fold
    counts: Counter[str]
    span: float | None
    dimension: Dimension
    linearity: Linearity
    peaks: Peaks
    tails: tuple[Tail, ...]
    gramian: Gramian
    sensitivity: Sensitivity
    arrivals: tuple[Arrivals, ...]
    calibration: list[Calibration]
    episodes: list[Episode]
    held_out: HeldOut


def check(twin: Twin, log: Log, counts: Counter[str]) -> Checked:
    """Compute all measures of a twin over a log.

    Raises:
        NisusError: If the twin's own filter does not run.
    """
    model, tuning = twin.model, twin.tuning
    speak = np.unique(log.channel[: log.n][log.kind[: log.n] == READING]).size
    fold, seconds = timed(twin, twin.estimator, log.events, tuning.seed, HELD_OUT_BUDGET_S / (speak + 2))
    span = None
    if fold.n < log.n:
        span = float(log.t[fold.n - 1] - log.t[0]) * 1e-9
        log.n = fold.log.n = fold.n
    fold.finish()
    readings = int(np.sum(log.kind[: log.n] == READING))
    covariance = fold.estimator.family not in ("particle", "ensemble")
    given = model, tuning, log
    return Checked(
        twin=twin,
        log=log,
        fold=fold,
        counts=counts,
        span=span,
        dimension=dimension(model, _rate(log), seconds * log.n / max(1, readings), covariance=covariance),
        linearity=linearity(*given),
        peaks=_peaks(twin, log),
        tails=tails(model, log, fold.track, marginal=fold.marginal),
        gramian=gramian(twin.estimator, *given),
        sensitivity=sensitivity(twin.estimator, *given, false_alarm=twin.policy.false_alarm_every),
        arrivals=tuple(item for item, fed in zip(arrivals(model, log), twin.expected, strict=True) if fed or item.n),
        calibration=calibration_of(twin, fold),
        episodes=episodes(fold),
        held_out=held_out(twin.estimator, *given),
    )


def _rate(log: Log) -> float:
    """Readings a second."""
    times = log.t[: log.n][log.kind[: log.n] == READING]
    span = float(times[-1] - times[0]) * 1e-9 if times.size else 0.0
    return (times.size - 1) / span if span > 0.0 else 0.0


def _peaks(twin: Twin, log: Log) -> Peaks:
    """Return the peaks of the twin's own particles, if it has any, else of a particle filter."""
    own = find_entry(twin.estimator)
    name = twin.estimator if own.peaks is not None else "pf"
    return peaks(name, twin.model, twin.tuning.with_options(twin.options_of(name)), log)
