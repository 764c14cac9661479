"""Check of a twin over its log: undetectable faults, observability, consistency; as figures and as topics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from config.source_schema import CanLogSection, CanSection, MergedSection
from estimators.diagnostics.calibration import BANDS, Calibration
from estimators.diagnostics.detectors import is_outside
from estimators.diagnostics.episodes import Episode, episode_json, episodes
from estimators.diagnostics.repeats import RepeatFinding
from estimators.diagnostics.score import health_of
from estimators.diagnostics.sensitivity import Gramian, GramianView, Sensitivity, bounds_of, sensitivities, worse_faults
from estimators.diagnostics.sensitivity.checklist import Arrivals, Dimension, Linearity, arrivals, dimension
from estimators.diagnostics.sensitivity.gramian import directions
from estimators.diagnostics.sensitivity.held_out import HeldOut, held_out
from estimators.diagnostics.sensitivity.posterior import Peaks, Tail, tails
from estimators.diagnostics.sensitivity.responses import NOW, PRIOR, SENSOR, digits
from estimators.diagnostics.sensitivity.sensitivity import TWO_SIGMA
from estimators.diagnostics.sensitivity.visibility import UndetectableFault
from estimators.errors import NisusError, spaced
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.model.state_space import StateSpaceModel

from ..result import WORSE, Bar, Cell, JsonObject, Topic, finite_text, plain
from ..twin.twin import Twin
from .advice.draft import undecided_lines
from .advice.measured import Measured, repeat_lines, repeats_of
from .advice.questions import JUMPS, heavy
from .calibration_lines import calibration_lines, health_shares
from .compare import timed
from .fold_result import calibration_json, calibration_of

BUDGET_S = 20.0  # seconds of one processor for the folds with held-out sensors, which limit the part of the log
MAX_CORRELATION = 0.9  # correlation beyond which two faults are hardly distinguishable
BEGINS = {PRIOR: "at the prior", NOW: "later"}  # words for the beginning of a fault
MAX_ROWS = 12  # rows of a table as text or HTML; JSON has all


class ChecklistLine(NamedTuple):
    """One question of the checklist: `answer` is yes, partly, no, or "not told"."""

    key: str
    question: str
    answer: str
    figures: str
    remedy: str

    @property
    def mark(self) -> str:
        """Rating of the answer, "good", "partly", "bad" or "": several peaks or heavy tails are bad news."""
        good, bad = ("no", "") if self.key == "posterior" else ("yes", "no")
        return {good: "good", bad: "bad", "not told": ""}.get(self.answer, "partly")


@dataclass(frozen=True)
class Checked:
    """All measurements on a twin. `span` is the part of the log, from its start, that was folded, s; None: all.

    sensitivity: to faults that are present from the prior on; onsets: to those that begin later, see `sensitivities`.
    """

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
    onsets: tuple[Sensitivity, ...]
    arrivals: tuple[Arrivals, ...]
    calibration: list[Calibration]
    episodes: list[Episode]
    held_out: HeldOut
    jumps: str
    repeats: dict[str, RepeatFinding]

    @property
    def health(self) -> dict[str, float]:
        """Share of time in each state of health."""
        return health_of(self.fold.log.events, self.fold.track, self.fold.policy)


def check(twin: Twin, log: Log, counts: Counter[str], *, executor: Executor | str | None = "threads") -> Checked:
    """Compute all measures of a twin over a log.

    Args:
        twin: The twin.
        log: Its log.
        counts: Numbers of dropped measurements, by reason.
        executor: Where faults and the Gramian are folded, nearly all of the work; see `sensitivity`.

    Raises:
        NisusError: If the twin's own filter does not run.
    """
    model, tuning = twin.model, twin.tuning
    reporting = np.unique(log.events.channel[log.events.kind == READING]).size
    fold, seconds = timed(twin, twin.estimator, log.events, tuning.seed, BUDGET_S / (reporting + 2))
    span = None
    if fold.n < log.n:
        span = fold.events.seconds
        log.n = fold.log.n = fold.n
    fold.finish()
    measured = Measured(twin, log, executor=executor)
    readings = int(np.sum(log.events.kind == READING))
    covariance = not fold.estimator.samples
    present, *onsets = sensitivities(
        twin.estimator, model, tuning, log, false_alarm=twin.policy.false_alarm_every, executor=executor
    )
    return Checked(
        twin=twin,
        log=log,
        fold=fold,
        counts=counts,
        span=span,
        dimension=dimension(model, measured.rate, seconds * log.n / max(1, readings), covariance=covariance),
        linearity=measured.linearity,
        peaks=measured.peaks,
        tails=tails(model, log, fold.track, marginal=fold.marginal),
        gramian=measured.gramian,
        sensitivity=present,
        onsets=tuple(onsets),
        arrivals=tuple(item for s, item in enumerate(arrivals(model, log)) if s in twin.plan.fed or item.n),
        calibration=calibration_of(fold, fold.log.events, fold.track),
        episodes=episodes(fold),
        held_out=held_out(twin.estimator, model, tuning, log),
        jumps=_jumps(measured),
        repeats=repeats_of(model, log),
    )


def _jumps(measured: Measured) -> str:
    """Return the finding of `nisus advise` that the asset jumps and not a sensor; empty if it does not."""
    try:
        reason = heavy(measured, measured.twin.estimator)[0].reason
    except NisusError:  # weights do not apply to this filter
        return ""
    return JUMPS if JUMPS in reason else ""


def confounded(found: Sensitivity) -> list[tuple[str, str, float]]:
    """Return pairs of faults that the log hardly distinguishes, with the correlation of their estimates.

    The correlation is that of two unknown faults with all others known; pairs beyond `MAX_CORRELATION` are returned,
    the largest first.
    """
    names = [nudge.subject for nudge in found.nudges[: len(found.fisher)]]
    root = np.sqrt(np.diag(found.fisher))
    with np.errstate(all="ignore"):
        c = -found.fisher / np.outer(root, root)
    pairs = [(names[i], names[j], float(c[i, j])) for i, j in zip(*np.triu_indices(len(names), 1), strict=True)]
    return sorted((pair for pair in pairs if abs(pair[2]) > MAX_CORRELATION), key=lambda pair: -abs(pair[2]))


def hidden_together(found: Sensitivity, one: str, other: str, correlation: float) -> str:
    """Return the largest undetectable faults at once of a pair of `confounded`, whose effects cancel, in words."""
    nudges = [nudge.subject for nudge in found.nudges]
    pair = [found.nudges[nudges.index(name)] for name in (one, other)]
    root = [1.0 / float(np.sqrt(found.fisher[k, k])) for k in map(nudges.index, (one, other))]
    sizes = root[0], float(np.sign(correlation)) * root[1]
    multiple = found.multiple((nudge.kind, nudge.name, size) for nudge, size in zip(pair, sizes, strict=True))
    ends = [nudge.high if size > 0.0 else nudge.low for nudge, size in zip(pair, sizes, strict=True)]
    multiple = min(multiple, *(end / size for end, size in zip(ends, sizes, strict=True)))
    if not np.isfinite(multiple):
        return "without limit"
    return " with ".join(nudge.in_words(multiple * size) for nudge, size in zip(pair, sizes, strict=True))


def stamps(twin: Twin) -> str:
    """Return the origin of the times of the measurements."""
    source = twin.config.source
    kinds = {type(part) for part in source.parts} if isinstance(source, MergedSection) else {type(source)}
    if kinds & {CanSection, CanLogSection}:
        return "frames are stamped where they are received, not at the sensor"
    return "every reading has the time at which it was measured"


def figures(checked: Checked, checklist: Sequence[ChecklistLine]) -> JsonObject:
    """Return all figures of a check; times in seconds of the log, null where there is no number.

    `checklist`: question, answer (yes, partly, no, not told), figures, remedy. `observability`: the Gramian of the log
    and of each window, and pairs of faults that the log hardly distinguishes, with the largest undetectable `together`.
    `smallest_visible`: minimal detectable size of every fault, null if there is none in its range, and the undetectable
    range `low` to `high`. `integrity`:
    protection level of each state beside 2 σ, and its fault. Both are the worse of faults that begin "now" and those
    present from the "prior" on (`begin`), over `window` seconds. `held_out`: prediction of each
    sensor row by the others. `open_loop`: RMS without measurements, by sensor row and by state with known truth;
    `worse` where that of the filter is larger.
    """
    twin, gramian, found, held = checked.twin, checked.gramian, checked.sensitivity, checked.held_out
    linearity, policy = checked.linearity, twin.policy

    def view(part: GramianView) -> JsonObject:
        return {
            "begin": part.begin * 1e-9,
            "end": part.end * 1e-9,
            "rank": part.rank,
            "conditioning": part.conditioning,
            "eigenvalues": part.eigenvalues,
            "forgotten": part.forgotten,
            "left": dict(zip(twin.model.state_names, part.left, strict=True)),
            "weakest": part.text,
        }

    integrity: JsonObject = {"reason": found.reason, "states": {}}
    if not found.reason:
        bounds = bounds_of(twin.model, found, *checked.onsets)
        integrity |= {
            "note": found.note,
            "estimator": found.estimator,
            "states": {name: bound._asdict() | {"fault": bound.fault or None} for name, bound in bounds.items()},
        }
    result: JsonObject = plain(
        {
            "twin": twin.name,
            "estimator": twin.estimator,
            "span": checked.span,
            "checklist": {line.key: line for line in checklist},
            "observability": {
                "estimator": gramian.estimator,
                "reason": gramian.reason,
                "note": gramian.note,
                "whole": None if gramian.whole is None else view(gramian.whole),
                "windows": [view(part) for part in gramian.windows],
                "blame": [
                    {
                        "one": pair[0],
                        "other": pair[1],
                        "correlation": pair[2],
                        "together": hidden_together(found, *pair),
                    }
                    for pair in confounded(found)
                ],
                "deviation": {
                    nudge.subject: value for nudge, value in zip(found.nudges, found.among().deviation, strict=False)
                },
            },
            "smallest_visible": [
                {
                    **{name: getattr(fault.nudge, name) for name in ("kind", "name", "unit", "value")},
                    "size": fault.visible,
                    "low": fault.low,
                    "high": fault.high,
                    "seen": np.isfinite(fault.visible),
                    "begin": one.begin,
                    "window": one.window,
                }
                for fault, one in worse_faults(found, *checked.onsets)
            ],
            "integrity": integrity,
            "held_out": {
                row.row: {
                    **{name: getattr(row, name) for name in ("sensor", "unit", "n", "rms", "bias")},
                    "coverage": {
                        f"{100 * band:.0f}": {"value": value, "low": low, "high": high}
                        for band, value, (low, high) in zip(BANDS, row.coverage, row.intervals, strict=True)
                    },
                    "open_loop": row.open_loop,
                    "worse": row.worse,
                }
                for row in held.rows
            },
            "open_loop": {
                "sensors": {row.row: {"unit": row.unit, "rms": row.open_loop} for row in held.rows},
                "states": {
                    item.state: {
                        "unit": item.unit,
                        "rms": item.open_loop,
                        "filter": item.filter,
                        "worse": item.worse,
                    }
                    for item in held.states
                },
            },
            "timing": {
                "stamps": stamps(twin),
                "horizon": twin.config.time.max_delay,
                "degraded_after": policy.degraded_after,
                "stale_after": policy.stale_after,
                "stale": checked.counts["stale"],
                "sensors": {item.sensor: item for item in checked.arrivals},
            },
            "calibration": [calibration_json(entry) for entry in checked.calibration],
            "posterior": {"peaks": checked.peaks, "tails": {tail.row: tail for tail in checked.tails}},
            "linearity": {
                **{name: getattr(linearity, name) for name in ("reason", "exact", "passes", "white", "text")},
                "states": {item.name: item for item in linearity.states},
                "rows": {item.name: item for item in linearity.rows},
                "whiteness": {item.row: item for item in linearity.whiteness},
            },
            "dimension": checked.dimension,
            "repeats": {name: one for name, one in checked.repeats.items() if one.found},
            "health": {
                "share": checked.health,
                "false_alarm_every": policy.false_alarm_every,
                "episodes": [episode_json(episode) for episode in checked.episodes],
            },
        }
    )
    return result


def topics(checked: Checked, checklist: Sequence[ChecklistLine]) -> list[Topic]:
    """Return a check as topics: title, checklist, faults, observability, held-out sensors, timing, health."""
    twin, log = checked.twin, checked.log
    seconds = log.events.seconds
    part = "the first" if checked.span is not None else "all"
    head = f"{twin.estimator} over {part} {seconds:.4g} s of its log, {log.n:,} events, {checked.dimension.nx:,} states"
    lines = tuple((line.question, line.answer, line.figures, line.remedy) for line in checklist)
    columns = ("question", "answer", "figures", "remedy")
    health = [f"{health_shares(checked.health)}.", *(episode.text for episode in checked.episodes[:MAX_ROWS])]
    if len(checked.episodes) > MAX_ROWS:
        health.append(f"... and {len(checked.episodes) - MAX_ROWS} more episodes.")
    health += calibration_lines(checked.calibration, twin.model)[: 2 * MAX_ROWS]
    asked = [
        f"valid_range.{state.name} leaves out the prior's mean, {state.mean:g}{spaced(state.unit)}: is it in that unit?"
        for state in twin.model.shown_states
        if state.name in twin.config.valid_range and state.fitted and is_outside(state, state.mean)
    ]
    return [
        Topic(f"{twin.name}: {twin.title}", (head, *asked)),
        Topic("Checklist", (), columns, lines, marks=tuple(line.mark for line in checklist)),
        *_fault_topics(checked),
        *_held_out_topics(checked),
        _timing(checked),
        Topic("Health and calibration", tuple(health)),
    ]


def _table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[tuple[Cell, ...]],
    *sentences: str,
    bars: Sequence[Bar] = (),
    legend: tuple[str, str] = ("", ""),
) -> Topic:
    """Return a topic with at most `MAX_ROWS` rows, a note on the others, and the sentences that are not empty."""
    shown = tuple(tuple(plain(cell) for cell in row) for row in rows)
    said = tuple(filter(None, sentences))
    topic = Topic(title, said, tuple(columns) if rows else (), shown, tuple(bars[:MAX_ROWS]), legend)
    return topic.cut(MAX_ROWS, ", see --json")


def _fault_topics(checked: Checked) -> list[Topic]:
    """Return protection levels, minimal detectable faults, observability, and faults that look alike."""
    found, gramian, model = checked.sensitivity, checked.gramian, checked.twin.model
    titles = (
        "Protection levels: error of a state under one undetectable fault",
        "Minimal detectable faults",
        "Faults that are hard to distinguish",
    )
    if found.reason:
        unknown = f"Not computed: {found.reason}. Any fault may stay undetected."
        levels, smallest, alike = (Topic(title, (unknown,)) for title in titles)
    else:
        note = f"{found.note}." if found.note else ""
        bounds = bounds_of(model, found, *checked.onsets)
        levels = _table(
            titles[0],
            ("state", "unit", "± 2 σ", "integrity bound", "by", "begins", "lasts, s"),
            [
                (name, item.unit, item.two_sigma, item.bound, item.fault or "none", BEGINS[item.begin], item.window)
                for name, item in bounds.items()
            ],
            note,
            bars=[Bar(name, item.unit, item.two_sigma, item.bound) for name, item in bounds.items()],
            legend=("± 2 σ", "integrity bound"),
        )
        smallest = _table(
            titles[1],
            ("fault", "smallest visible", "passes unseen", "moves", "begins"),
            [
                (
                    fault.nudge.subject,
                    fault.nudge.size_text(fault.visible) if np.isfinite(fault.visible) else "undetectable in its range",
                    fault.range_text,
                    moves,
                    BEGINS[one.begin],
                )
                for _, fault, one, moves in _by_harm(model, worse_faults(found, *checked.onsets))
            ],
            note,
            "Smallest fault that is detected with a probability of 95 %, the worse of two: present from the prior on, "
            f"for {found.window:.4g} s, or beginning later, for {checked.onsets[0].window:.4g} s. First the fault "
            "whose undetectable part moves a state furthest out of its band.",
            *_missing_offsets(checked),
        )
        pairs = confounded(found)
        free = (
            [item for item in directions(found.fisher, found.nudges[: len(found.fisher)]) if not item.deviation < 1.0]
            if len(found.fisher)
            else []
        )
        alike = _table(
            titles[2],
            ("one", "other", "correlation", "hidden together"),
            [(one, other, f"{value:+.2f}", hidden_together(found, one, other, value)) for one, other, value in pairs],
            note,
            "The log does not distinguish these faults."
            if pairs
            else f"No two faults look alike: no correlation is beyond {MAX_CORRELATION:g}.",
            f"With all unknown together {len(free)} combination(s) cannot be determined, first {free[0].text}."
            if free
            else "",
        )
    title = "Observability"
    if gramian.whole is None:
        return [levels, smallest, Topic(title, (f"Not computed: {gramian.reason}.",)), alike]
    begin = float(gramian.whole.begin)
    views = [
        (
            f"{(view.begin - begin) * 1e-9:.4g} to {(view.end - begin) * 1e-9:.4g} s",
            f"{view.rank} of {model.nx}",
            view.conditioning,
            view.text,
        )
        for view in (gramian.whole, *gramian.windows)
    ]
    columns = ("part of the log", "rank", "conditioning", "weakest direction")
    return [levels, smallest, _table(title, columns, views, f"{gramian.note}." if gramian.note else ""), alike]


def _missing_offsets(checked: Checked) -> list[str]:
    """Return which rows of sensors need an `offset`: an undetected one from the start moves a state out of its band."""
    twin, found = checked.twin, checked.sensitivity
    given = {name for name, section in twin.config.sensors.items() if section.offset is not None}
    faults = [(fault, found) for fault in found.faults if fault.nudge.kind == SENSOR]
    return [
        f"{fault.nudge.name} has no offset: {fault.range_text} from the start passes unseen and moves {moves}. Declare "
        f"its accuracy, sensors.{name}.offset: {{std: ...}}, and the band contains it."
        for share, fault, _, moves in _by_harm(twin.model, faults)
        if share > TWO_SIGMA and (name := fault.nudge.name.partition(".")[0]) not in given
    ]


def _by_harm(
    model: StateSpaceModel, faults: Iterable[tuple[UndetectableFault, Sensitivity]]
) -> list[tuple[float, UndetectableFault, Sensitivity, str]]:
    """Return faults by the largest error of a state, in its standard deviations, with that error in words."""
    found = []
    for fault, one in faults:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.nan_to_num(fault.error[-1] / one.std[-1], nan=0.0, posinf=np.inf)
        k = int(np.argmax(share))
        state, error, band = model.shown_states[k], float(fault.error[-1, k]), TWO_SIGMA * float(one.std[-1, k])
        size = f"{digits(error)}{spaced(state.unit)}"
        moves = f"{state.name} by {size} (band ± {digits(band)})" if error > 0.0 else "nothing"
        found.append((float(share[k]), fault, one, moves))
    return sorted(found, key=lambda item: -item[0])


def _held_out_topics(checked: Checked) -> list[Topic]:
    """Return the prediction of each held-out sensor, and the filter against the model alone."""
    rows, states = checked.held_out.rows, checked.held_out.states
    said = [
        f"{row.row} is predicted {WORSE}: RMS {finite_text(row.rms)} {row.unit} by the other sensors, "
        f"{finite_text(row.open_loop)} by the model alone."
        for row in rows
        if row.worse
    ]
    if len({row.sensor for row in rows}) == 1:
        said.append("There is one sensor: held out, it leaves the open loop.")
    held = _table(
        "Each sensor held out and predicted by the others",
        ("sensor row", "unit", "RMS", "bias", *(f"in {100 * band:.0f} %" for band in BANDS), "open loop", ""),
        [
            (
                *(row.row, row.unit, row.rms, f"{row.bias:+.3g}"),
                *(f"{100 * share:.3g}" for share in row.coverage),
                row.open_loop,
                WORSE if row.worse else "",
            )
            for row in rows
        ],
        *said[:MAX_ROWS],
        bars=[Bar(row.row, row.unit, row.rms, row.open_loop) for row in rows],
        legend=("RMS by the other sensors", "RMS without measurements"),
    )
    title = "Filter against the model alone, where the truth is known"
    if not states:
        return [held, Topic(title, ("The log has no true states: see the held-out sensors.",))]
    open_loop = _table(
        title,
        ("state", "unit", "RMS of the filter", "RMS of the open loop", ""),
        [(item.state, item.unit, item.filter, item.open_loop, WORSE if item.worse else "") for item in states],
        *(
            f"The filter makes {item.state} {WORSE}: RMS {finite_text(item.filter)} {item.unit} with measurements, "
            f"{finite_text(item.open_loop)} without."
            for item in states
            if item.worse
        ),
        bars=[Bar(item.state, item.unit, item.filter, item.open_loop) for item in states],
        legend=("filter", "open loop"),
    )
    return [held, open_loop]


def _timing(checked: Checked) -> Topic:
    known = any(np.isfinite(item.lateness).any() for item in checked.arrivals)
    return _table(
        "Arrival of measurements",
        ("sensor", "readings", "a second", "longest gap, s", "missing, %", "lateness, s: half, 99 %, worst"),
        [
            (
                *(item.sensor, item.n, item.rate, item.gap),
                f"{100 * item.missing:.2g}" if np.isfinite(item.missing) else "-",
                " / ".join(map(finite_text, item.lateness)) if known else "not known",
            )
            for item in checked.arrivals
        ],
        "" if known else "Lateness is not known: the log has only the time of measurement.",
        *(f"{line}." for line in (*repeat_lines(checked.repeats), *undecided_lines(checked.repeats.items()))),
    )
