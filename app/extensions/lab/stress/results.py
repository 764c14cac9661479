"""Results of a stress test as topics: a row for each fault and filter, expected against actual detections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from app.result import Cell, TableColumn, Topic

from .detection import CHANCE, FALSE, INVISIBLE, MISNAMED, MISSED, NAMED, UNSEEN, Trial
from .scenario import Mistake

DETECTION_COLUMNS: tuple[TableColumn | str, ...] = (
    *("mistake", "filter", "visible from", "outcome"),
    *(TableColumn(title, 1) for title in ("named [s]", "alarm [s]")),
    *(TableColumn("green [%]", 0, 100.0), TableColumn("recovered [s]", 1), "first named", "right"),
)
ERROR_COLUMNS: tuple[TableColumn | str, ...] = (
    *("mistake", "filter", "state", "undamaged", "gate", "no gate"),
    TableColumn("in band [%]", 0, 100.0),
)


WRONG_COLUMNS = ("faults", "made", "a state is wrong", "undetected", "listed", "neither")


def stress_topics(title: str, trials: Sequence[Trial], mistakes: Sequence[Mistake]) -> list[Topic]:
    """Return a table of medians over the seeds, and sums over all trials."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.mistake, trial.estimator), []).append(trial)
    names = dict.fromkeys(trial.estimator for trial in trials)
    made = {mistake.name: mistake for mistake in mistakes}
    keys = [(mistake, name) for mistake in made for name in names if (mistake, name) in groups]
    rows = tuple((*key, *_detection_cells(groups[key], made[key[0]])) for key in keys)
    errors = tuple((*key, *_error_cells(groups[key])) for key in keys if groups[key][0].calm)
    real = [trial for trial in trials if made[trial.mistake].causes]
    found = [trial for trial in real if trial.outcome in (NAMED, MISNAMED)]
    hidden = [trial for trial in real if trial.foretold == INVISIBLE]
    chance = [trial for trial in real if trial.foretold == CHANCE]
    sensors = [trial for trial in found if made[trial.mistake].subjects]
    harmless = [trial for trial in trials if not made[trial.mistake].causes]
    wrong = [f"{key[0]} ({key[1]})" for key in keys if 2 * _count(groups[key], MISSED) >= len(groups[key])]
    sentences = (
        f"{sum(trial.early for trial in trials)} false alarms in {sum(trial.start for trial in trials) / 3600.0:.1f} h "
        "before the mistakes",
        f"visible: {len(real) - len(hidden) - len(chance)}, {_count(real, MISSED)} MISSED; "
        f"invisible: {len(hidden)}, {len(hidden) - _count(hidden, UNSEEN)} found all the same; "
        f"by chance: {len(chance)}, {len(chance) - _count(chance, UNSEEN)} found",
        f"of {len(found)} found the cause is right in {_share([trial.cause_right for trial in found])}, "
        f"of {len(sensors)} of one sensor the sensor in {_share([trial.subject_right for trial in sensors])}",
        f"of {len(harmless)} that the log corrects {_count(harmless, FALSE)} raised an alarm",
        f"{len(wrong)} rows wrong and green{': ' if wrong else ''}{', '.join(wrong)}",
    )
    unlisted = [f"{t.mistake} ({t.estimator}, seed {t.seed}): {t.wrong}" for t in real if t.wrong and _unknown(t)]
    return [
        Topic(title, (), DETECTION_COLUMNS, rows),
        Topic("RMSE of the state whose error grew most", (), ERROR_COLUMNS, errors),
        Topic("Wrong states, detected or listed by nisus check beforehand", (), WRONG_COLUMNS, _wrong_rows(real, made)),
        Topic("Wrong, undetected and not listed", tuple(unlisted) or ("none",)),
        Topic("All", sentences),
    ]


def _unknown(trial: Trial) -> bool:
    return not trial.detected and not trial.listed


def _wrong_rows(trials: Sequence[Trial], made: Mapping[str, Mistake]) -> tuple[tuple[Cell, ...], ...]:
    """Return counts of faults, wrong states, and of these undetected, listed and neither."""
    groups = {
        "some time": [t for t in trials if not made[t.mistake].whole],
        "from the start": [t for t in trials if made[t.mistake].whole],
        "of these two at once": [t for t in trials if made[t.mistake].parts > 1],
        "all": list(trials),
    }
    rows = []
    for title, group in groups.items():
        wrong = [t for t in group if t.wrong]
        hidden = [t for t in wrong if not t.detected]
        counts = (len(group), len(wrong), len(hidden), sum(t.listed for t in hidden), sum(map(_unknown, hidden)))
        rows.append((title, *counts))
    return tuple(rows)


def _count(trials: Sequence[Trial], outcome: str) -> int:
    return sum(trial.outcome == outcome for trial in trials)


def _share(right: Sequence[bool]) -> str:
    return f"{100.0 * float(np.mean(right)):.0f} %" if right else "-"


def _median(values: Sequence[float | None]) -> Cell:
    """Return the median, the lower of two; never counts as later than any time."""
    middle = sorted(np.inf if value is None else value for value in values)[(len(values) - 1) // 2]
    return float(middle) if np.isfinite(middle) else "never"


def _visible_from(own: Sequence[Trial], mistake: Mistake) -> str:
    """Return the expected detection: the minimal detectable size beside the fault's own, or a word."""
    multiple = float(np.median([trial.visible_from for trial in own]))
    if np.isnan(multiple):
        return max(Counter(sorted(trial.foretold for trial in own)).items(), key=lambda item: item[1])[0]
    if not np.isfinite(multiple):
        return "never"
    if np.isnan(mistake.size):
        return f"× {multiple:.2g}"
    return f"{multiple * mistake.size:.2g} of {mistake.size:.2g} {mistake.unit}"


def _outcomes(own: Sequence[Trial]) -> str:
    """Return the different outcomes with their counts, the most frequent first."""
    counts = sorted(Counter(trial.outcome for trial in own).items(), key=lambda item: (-item[1], item[0]))
    return counts[0][0] if len(counts) == 1 else ", ".join(f"{n} {word}" for word, n in counts)


def _detection_cells(own: Sequence[Trial], mistake: Mistake) -> tuple[Cell, ...]:
    named = Counter(trial.named for trial in own if trial.named).most_common(1)
    return (
        _visible_from(own, mistake),
        _outcomes(own),
        _median([trial.delay for trial in own]) if mistake.causes else "-",
        _median([trial.word for trial in own]),
        float(np.median([trial.green for trial in own])),
        _median([trial.recovery for trial in own]) if mistake.fault is not None else "-",
        named[0][0] if named else "-",
        f"{sum(trial.cause_right and trial.subject_right for trial in own)}/{len(own)}" if mistake.causes else "-",
    )


def _error_cells(own: Sequence[Trial]) -> tuple[Cell, ...]:
    """Return the RMSE of one state without the fault, with it and a gate, and with it and no gate; and its coverage."""
    medians = {
        name: [float(np.median([getattr(trial, kind)[name] for trial in own])) for kind in ("calm", "error", "bare")]
        for name in own[0].calm
    }
    worst = max(medians, key=lambda name: medians[name][1] / max(medians[name][0], 1e-300))
    return (worst, *medians[worst], float(np.median([trial.coverage[worst] for trial in own])))
