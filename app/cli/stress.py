"""`nisus stress`: deliberate faults of a twin, and how soon and how correctly they are detected."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from estimators.errors import ConfigError, NisusError
from estimators.registry import find_estimator

from ..present.result import to_json
from ..studies.stress.detection import CHANCE, FALSE, INVISIBLE, MISNAMED, MISSED, NAMED, UNSEEN, Oracle, Trial, make
from ..studies.stress.matrix import matrix
from ..studies.stress.scenario import Bench, Mistake, asset_of
from ..terminal import complain
from ..twin.twin import load_twin
from .options import settings
from .prepare import prepare
from .progress import progress

if TYPE_CHECKING:
    from .arguments import Stress as Arguments

PIPE_WIDTH = 220  # columns of the output where it is not a terminal


def stress_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    twin = load_twin(
        arguments.twin, log_files=arguments.log or None, overrides=settings(arguments.set, tuning=arguments.tuning)
    )
    if arguments.seeds < 1:
        raise ConfigError(f"--seeds {arguments.seeds}: must be 1 or more")
    if not arguments.duration > 0:
        raise ConfigError(f"--duration {arguments.duration:g}: must be positive")
    names = list(dict.fromkeys(arguments.estimators or (twin.estimator,)))
    for name in names:
        find_estimator(name, twin.model)
    prepare(twin)
    first = Bench(twin, 0, arguments.duration)
    simulated = asset_of(twin, 0) is not None
    mistakes = _chosen(matrix(twin.model, twin.tuning, first.events, asset=simulated), arguments.only)
    if arguments.list:
        print("\n".join(item.name for item in mistakes))
        return 0
    oracle = Oracle(twin, arguments.duration)
    trials: list[Trial] = []
    failed: list[str] = []
    with progress(
        f"{twin.name}, {len(mistakes)} mistakes", len(mistakes) * len(names) * arguments.seeds, "folds"
    ) as on:
        for seed in range(arguments.seeds):
            bench = first if seed == 0 else Bench(twin, seed, arguments.duration)
            for name in names:
                for mistake in mistakes:
                    try:
                        foretold = oracle.foretell(bench, mistake, name)
                        trials.append(make(bench, mistake, name, foretold))
                    except NisusError as error:
                        failed.append(f"{mistake.name}, {name}, seed {seed}: {error}")
                    on()
    for text in failed:
        complain(text)
    if arguments.json:
        print(to_json(trials))
    else:
        _print(trials, mistakes, names)
    return 0


def _chosen(mistakes: Sequence[Mistake], only: Sequence[str]) -> list[Mistake]:
    """Return the faults whose name contains one of `only`; all without it."""
    found = [item for item in mistakes if not only or any(text.lower() in item.name.lower() for text in only)]
    if not found:
        raise ConfigError(f"--only {' '.join(only)}: no mistake has that in its name; see --list")
    return found


def _print(trials: Sequence[Trial], mistakes: Sequence[Mistake], names: Sequence[str]) -> None:
    console = Console()
    if not console.is_terminal:
        console = Console(width=PIPE_WIDTH)
    table = Table()
    for title in ("mistake", "filter", "visible from"):
        table.add_column(title, no_wrap=True)
    table.add_column("outcome", no_wrap=True)
    for title in ("named after s", "first word s", "green %", "recovered s"):
        table.add_column(title, justify="right", min_width=6)
    for title in ("named first", "right", "worst state: undamaged, gate, no gate", "in the band %"):
        table.add_column(title, no_wrap=True)
    wrong = []
    for mistake in mistakes:
        for name in names:
            own = [trial for trial in trials if (trial.mistake, trial.estimator) == (mistake.name, name)]
            if own:
                table.add_row(escape(mistake.name), name, *_cells(own, mistake))
                if 2 * sum(trial.outcome == MISSED for trial in own) >= len(own):
                    wrong.append(f"{mistake.name} ({name})")
    console.print(table)
    early = sum(trial.early for trial in trials)
    hours = sum(trial.start for trial in trials) / 3600.0
    console.print(f"{early} false alarms in {hours:.1f} h before the mistakes")
    console.print("\n".join(_summary(trials, mistakes)), markup=False, highlight=False)
    console.print(f"{len(wrong)} rows wrong and green{': ' if wrong else ''}{', '.join(wrong)}", markup=False)


def _summary(trials: Sequence[Trial], mistakes: Sequence[Mistake]) -> list[str]:
    """Return expected against actual detections, and how correctly they were named."""
    made = {mistake.name: mistake for mistake in mistakes}
    real = [trial for trial in trials if made[trial.mistake].causes]
    found = [trial for trial in real if trial.outcome in (NAMED, MISNAMED)]
    hidden = [trial for trial in real if trial.foretold == INVISIBLE]
    chance = [trial for trial in real if trial.foretold == CHANCE]
    visible = len(real) - len(hidden) - len(chance)
    sensors = [trial for trial in found if made[trial.mistake].subjects]
    calm = [trial for trial in trials if not made[trial.mistake].causes]
    return [
        f"visible: {visible}, {sum(trial.outcome == MISSED for trial in real)} MISSED; "
        f"invisible: {len(hidden)}, {sum(trial.outcome != UNSEEN for trial in hidden)} found all the same; "
        f"by chance: {len(chance)}, {sum(trial.outcome != UNSEEN for trial in chance)} found",
        f"of {len(found)} found the cause is right in {_share([trial.cause_right for trial in found])}, "
        f"of {len(sensors)} of one sensor the sensor in {_share([trial.subject_right for trial in sensors])}",
        f"of {len(calm)} that the log undoes {sum(trial.outcome == FALSE for trial in calm)} were heard of",
    ]


def _share(right: Sequence[bool]) -> str:
    return f"{100.0 * float(np.mean(right)):.0f} %" if right else "-"


def _median(values: Sequence[float | None]) -> str:
    """Return the median; never counts as later than any time."""
    ordered = sorted(np.inf if value is None else value for value in values)
    middle = ordered[(len(ordered) - 1) // 2]
    return f"{middle:.1f}" if np.isfinite(middle) else "never"


def _visible_from(own: Sequence[Trial], mistake: Mistake) -> str:
    """Return the expected detection: the minimal detectable size beside the fault's own, or a word."""
    words = [trial.foretold for trial in own]
    word = max(sorted(set(words)), key=words.count)
    multiple = float(np.median([trial.visible_from for trial in own]))
    if np.isnan(multiple):
        return word
    if not np.isfinite(multiple):
        return "never"
    if np.isnan(mistake.size):
        return f"× {multiple:.2g}"
    return f"{multiple * mistake.size:.2g} of {mistake.size:.2g} {mistake.unit}"


def _often(words: Sequence[str]) -> str:
    """Return the different words with their counts, the most frequent first."""
    counts = sorted({(-words.count(word), word) for word in words})
    return counts[0][1] if len(counts) == 1 else ", ".join(f"{-n} {word}" for n, word in counts)


def _cells(own: Sequence[Trial], mistake: Mistake) -> list[str]:
    """Return the figures of one fault and filter, medians over the seeds."""
    said = [trial.named for trial in own if trial.named]
    most = max(set(said), key=said.count) if said else "-"
    right = sum(trial.cause_right and trial.subject_right for trial in own)
    states = {
        name: [float(np.median([getattr(trial, which)[name] for trial in own])) for which in ("calm", "error", "bare")]
        for name in own[0].calm
    }
    worst = max(states, key=lambda name: states[name][1] / max(states[name][0], 1e-300), default=None)
    error, inside = "-", "-"
    if worst is not None:
        error = f"{escape(worst)}: {', '.join(f'{value:.3g}' for value in states[worst])}"
        inside = f"{100 * float(np.median([trial.coverage[worst] for trial in own])):.0f}"
    return [
        _visible_from(own, mistake),
        _often([trial.outcome for trial in own]),
        _median([trial.delay for trial in own]) if mistake.causes else "-",
        _median([trial.word for trial in own]),
        f"{100 * float(np.median([trial.green for trial in own])):.0f}",
        "-" if mistake.fault is None else _median([trial.recovery for trial in own]),
        escape(most),
        f"{right}/{len(own)}" if mistake.causes else "-",
        error,
        inside,
    ]
