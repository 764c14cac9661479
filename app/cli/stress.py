"""`nisus stress`: deliberate faults of a twin, and how soon and how correctly they are detected."""

from __future__ import annotations

from typing import TYPE_CHECKING

from estimators.errors import ConfigError, NisusError
from estimators.registry import find_estimator

from ..present.result import to_json, to_text
from ..studies.stress.detection import Oracle, Trial, make
from ..studies.stress.matrix import matrix
from ..studies.stress.results import stress_topics
from ..studies.stress.scenario import Bench, asset_of
from ..terminal import complain
from .prepare import opened, prepare, progress

if TYPE_CHECKING:
    from .arguments import StressCommand as Arguments


def stress_twin(arguments: Arguments) -> int:
    """Run the command."""
    twin = opened(arguments)
    if arguments.seeds < 1:
        raise ConfigError(f"--seeds {arguments.seeds}: must be 1 or more")
    if not arguments.duration > 0:
        raise ConfigError(f"--duration {arguments.duration:g}: must be positive")
    names = list(dict.fromkeys(arguments.estimators or (twin.estimator,)))
    for name in names:
        find_estimator(name, twin.model)
    prepare(twin)
    first = Bench(twin, 0, arguments.duration)
    mistakes = [
        item
        for item in matrix(twin.model, twin.tuning, first.events, asset=asset_of(twin, 0) is not None)
        if not arguments.only or any(text.lower() in item.key for text in arguments.only)
    ]
    if not mistakes:
        raise ConfigError(f"--only {' '.join(arguments.only)}: no mistake has that in its name; see --list")
    if arguments.list:
        names = [item.name for item in mistakes]
        print(to_json(names) if arguments.json else "\n".join(names))
        return 0
    oracle = Oracle(twin, arguments.duration)
    trials: list[Trial] = []
    failed: list[str] = []
    title = f"{twin.name}, {len(mistakes)} mistakes"
    folds = len(mistakes) * len(names) * arguments.seeds
    with progress(title, folds, "folds") as advance:
        try:
            for seed in range(arguments.seeds):
                bench = first if seed == 0 else Bench(twin, seed, arguments.duration)
                for name in names:
                    for mistake in mistakes:
                        try:
                            foretold = oracle.foretell(bench, mistake, name)
                            listed = oracle.listed(first, mistake, name)
                            trials.append(make(bench, mistake, name, foretold, listed=listed))
                        except NisusError as error:
                            failed.append(f"{mistake.name}, {name}, seed {seed}: {error}")
                        advance()
        except KeyboardInterrupt:
            if not trials:
                raise
            failed.append(f"interrupted after {len(trials)} of {folds} folds")
            mistakes = [item for item in mistakes if any(trial.mistake == item.name for trial in trials)]
    for text in failed:
        complain(text)
    print(to_json(trials) if arguments.json else "\n".join(to_text(stress_topics(title, trials, mistakes))))
    return 130 if len(trials) < folds and failed and failed[-1].startswith("interrupted") else 0
