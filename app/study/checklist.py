"""Checklist of a twin: eight questions, each with an answer, the figures behind it and a remedy."""

from __future__ import annotations

import numpy as np

from estimators.diagnostics.calibration import LIMITS
from estimators.diagnostics.sensitivity.checklist import MAX_PROCESSOR_SHARE, spread_error
from estimators.diagnostics.sensitivity.posterior import FREQUENT_SHARE
from estimators.diagnostics.sensitivity.responses import digits
from estimators.log import MAINTENANCE
from estimators.registry import ESTIMATORS, unfit

from .advice.measured import bytes_text, seconds_text
from .calibration_lines import health_shares
from .check import Checked, ChecklistLine, confounded, stamps
from .scores import scores_file

YES, PARTLY, NO, NONE = "yes", "partly", "no", "not told"

MAX_CONDITIONING = 1e8  # conditioning beyond which the information of the weakest direction is rounding

Answer = tuple[str, str, str]  # answer, figures, remedy


def checklist(checked: Checked) -> list[ChecklistLine]:
    """Return the answers to all questions, in their order."""
    return [ChecklistLine(key, question, *answer(checked)) for key, question, answer in QUESTIONS]


def _linearity(checked: Checked) -> Answer:
    found, name = checked.linearity, checked.twin.estimator
    if found.passes is None:
        return NONE, found.reason, ""
    if not found.passes:
        remedy = f"{name}, which runs here, does not linearise"
        return NO, found.text, "ukf or ckf see the curvature" if checked.fold.estimator.linearises else remedy
    if found.white:
        return YES, found.text, ""
    return PARTLY, found.text, "correlation above zero: more Q, or a state is missing; below: less Q"


def _dimension(checked: Checked) -> Answer:
    found, fold = checked.dimension, checked.fold
    entry = fold.estimator
    figures = (
        f"{found.nx:,} states, {found.rate:.3g} readings a second; a covariance step is {digits(found.flops)} "
        f"operations on {bytes_text(found.memory)}; {entry.name} takes {seconds_text(found.seconds)} a reading, "
        f"{100 * found.share:.2g} % of one processor"
    )
    if np.isfinite(found.largest) and found.largest > found.nx:
        figures += f" (growing with n³, all of it at {found.largest:,.0f} states)"
    members = fold.options.get("members", fold.options.get("particles", 0.0))
    if members:
        figures += f"; {members:,.0f} members: each σ is off by {100 * spread_error(members):.2g} % by chance"
    else:
        figures += f"; an ensemble would need {found.members} members for σ within 10 %"
    remedy = "an ensemble is what runs" if entry.family == "ensemble" else ""
    if found.share > MAX_PROCESSOR_SHARE:
        limit = f"{100 * MAX_PROCESSOR_SHARE:.0f} % of a processor"
        remedy = f"more than {limit}: fewer readings, fewer members, or another filter"
    return YES if found.passes and entry.family != "ensemble" else PARTLY if found.passes else NO, figures, remedy


def _posterior(checked: Checked) -> Answer:
    found, gate = checked.peaks, checked.twin.tuning.gate
    if found.reason:
        said = [f"peaks are not computed: {found.reason}"]
    else:
        said = [
            f"{100 * found.several:.2g} % of {found.looks} samples of the cloud of {found.estimator} over "
            f"{found.over:.4g} s have more than one peak (at most {found.most})"
        ]
        if found.recoveries:
            said.append(f"the cloud was lost {found.recoveries} time(s), so its shape is not reliable")
    heavy = sum(tail.heavy for tail in checked.tails)
    worst = max(checked.tails, key=lambda tail: tail.kurtosis, default=None)
    if worst is not None:
        said.append(
            f"innovations: {heavy} of {len(checked.tails)} rows are heavy-tailed, the worst {worst.row} with excess "
            f"kurtosis {worst.kurtosis:.2g} and {100 * worst.far:.2g} % beyond 4 σ"
        )
    figures = "; ".join(said)
    if not found.reason and not found.recoveries and found.several > FREQUENT_SHARE:
        fold = checked.fold
        able = [entry.name for entry in ESTIMATORS.values() if entry.peaks and unfit(entry, fold.model) is None]
        one = f"{fold.estimator.name} has one peak: use {', '.join(able)}"
        return YES, figures, "particles carry the peaks" if fold.estimator.peaks else one
    # A few of many rows have heavy tails by chance.
    if heavy <= FREQUENT_SHARE * len(checked.tails):
        return NONE if found.reason and worst is None else NO, figures, ""
    if checked.linearity.passes is not None and not checked.linearity.white:
        remedy = "innovations are correlated too, which points to model errors: a gate would reject good measurements"
    elif jumps := checked.jumps:
        remedy = f"{jumps}; no gate, and no particles"
    elif gate is None:
        remedy = "heavy tails need a gate, not particles: set gate: 0.99999"
    else:
        remedy = "heavy tails: the gate rejects the largest outliers"
    return PARTLY, figures, remedy


def _observability(checked: Checked) -> Answer:
    found, whole = checked.gramian, checked.gramian.whole
    if whole is None:
        return NONE, found.reason, ""
    figures = f"{whole.summary}; the weakest direction is {whole.text}"
    if found.windows:
        ranks = [window.rank for window in found.windows]
        each = f"{min(ranks)}" if min(ranks) == max(ranks) else f"{min(ranks)} to {max(ranks)}"
        figures += f"; of {len(ranks)} parts of the log each alone gives rank {each}"
    pairs = confounded(checked.sensitivity)
    if pairs:
        first, second, value = pairs[0]
        figures += f"; {len(pairs)} pair(s) look alike in the readings, most of all {first} and {second} ({value:+.2f})"
    if whole.beyond:
        return NONE, f"{figures}; {found.note}", ""
    model = checked.twin.model
    if names := whole.unobserved(model):
        remedy = f"{', '.join(names)} keeps its prior and drifts: add a sensor, or rely on its band only"
        return NO, figures, remedy
    if whole.rank + whole.forgotten < int(np.sum(model.prior_std > 0.0)) or whole.conditioning > MAX_CONDITIONING:
        remedy = "the measurements determine the weakest direction worse than the prior: rely on its band only"
        return PARTLY, figures, remedy
    if pairs:
        return PARTLY, figures, "do not estimate both of a pair from this log; measure one, or excite the asset more"
    return YES, figures, ""


def _timing(checked: Checked) -> Answer:
    horizon, policy = checked.twin.config.time.max_delay, checked.twin.policy
    reporting = [item for item in checked.arrivals if item.n]
    late = [item.lateness[-1] for item in reporting if np.isfinite(item.lateness[-1])]
    by_chance = {sensor.name for sensor in checked.twin.model.sensors if sensor.by_chance}
    steady = [item for item in checked.arrivals if item.sensor not in by_chance]
    absent = [item.sensor for item in steady if not item.n]
    stale, origin = checked.counts["stale"], stamps(checked.twin)
    said = [origin]
    worst = max(steady, key=lambda item: np.nan_to_num(item.gap), default=None)
    if worst is not None and np.isfinite(worst.gap):
        said.append(f"longest gap {worst.gap:.3g} s ({worst.sensor})")
    if late:
        said.append(f"worst lateness {max(late):.3g} s for a horizon of {horizon:g} s")
    else:
        said.append(f"when readings arrived is not known; the horizon is {horizon:g} s")
    said.append(f"{stale} stale; degraded after {policy.degraded_after:g} s, stale after {policy.stale_after:g} s")
    remedy = ""
    if absent:
        said.append(f"never reported: {', '.join(absent)}")
    if stale:
        remedy = f"{stale} reading(s) came later than the horizon: raise time.max_delay"
    elif absent:
        remedy = "check the channel map of the sensors that never reported"
    elif worst is not None and worst.gap > policy.degraded_after:
        remedy = f"{worst.sensor} drops out for longer than {policy.degraded_after:g} s: degraded meanwhile"
    complete = late and "measured" in origin and not absent
    return NO if stale else YES if complete else PARTLY, "; ".join(said), remedy


def _health(checked: Checked) -> Answer:
    found = checked.episodes
    wrong = [entry for entry in checked.calibration if entry.words]
    seconds = checked.twin.policy.false_alarm_every
    figures = (
        f"at most one false alarm {'a day' if seconds == 86400.0 else f'in {seconds:g} s'}; "
        f"{health_shares(checked.health)}; {len(found)} episode(s); "
        f"calibration off in {len(wrong)} of {len(checked.calibration)} rows and states"
    )
    return YES, figures, found[0].text if found else wrong[0].words[0] if wrong else ""


def _tuning(checked: Checked) -> Answer:
    path, baseline, forced = checked.twin.path, checked.twin.tuning.baseline, checked.twin.forced_baseline
    scores = scores_file(path)
    wide = 1.0 + LIMITS.width
    off = [
        entry.subject for entry in checked.calibration if entry.role == "used" and entry.scale.beyond(1.0 / wide, wide)
    ]
    figures = (
        f"Q and R are those of {path.name}; their baseline is {'not ' * (baseline is None)}stored"
        f"{' with --force: ' * bool(forced)}{forced}; scores of every "
        f"filter are {f'in {scores.name}' if scores.exists() else 'not stored'}; bands off by more than a quarter: "
        f"{', '.join(off[:4]) if off else 'none'}{f' and {len(off) - 4} more' if len(off) > 4 else ''}"
    )
    remedies = []
    if baseline is None:
        remedies.append(f"nisus commission {path.stem} stores the baseline, so that a change is detected")
    if not scores.exists():
        remedies.append(f"nisus compare {path.stem} --write stores the scores")
    return PARTLY if scores.exists() or not remedies else NO, figures, "; ".join(remedies)


def _change(checked: Checked) -> Answer:
    log = checked.log
    count = int(np.sum(log.events.kind == MAINTENANCE))
    figures = f"each maintenance increases the version of {checked.twin.model.name}; {count} in this log"
    if count:
        return YES, figures, ""
    return PARTLY, figures, "report maintenance to the twin, so that the covariance of the changed part is reset"


QUESTIONS = (
    ("linearity", "Does a linearised model pass innovation whiteness over what the log covers?", _linearity),
    ("dimension", "Is n small enough for O(n³) at this rate, or is an ensemble required?", _dimension),
    ("posterior", "Is the posterior multimodal, or is the noise heavy-tailed?", _posterior),
    (
        "observability",
        "Is the Gramian well conditioned for every state and parameter that is estimated?",
        _observability,
    ),
    ("timing", "Are there source timestamps, a buffer for the worst latency, and a policy for stale data?", _timing),
    ("health", "Are NIS, whiteness and rejections monitored, with alerts and a documented response?", _health),
    ("tuning", "Are Q and R fitted on recorded data, versioned, and covered by regression tests?", _tuning),
    ("change", "Is the model version tied to maintenance events?", _change),
)
