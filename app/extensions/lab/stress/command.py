"""`nisus stress`: deliberate faults of a twin, and how soon and how correctly they are detected."""

from __future__ import annotations

from app.cli.options import overrides_of
from app.cli.prepare import opened, prepare, progress
from app.render.text import to_text
from app.result import to_json
from app.terminal import complain
from estimators.errors import ConfigError
from estimators.registry import find_estimator

from ..arguments import StressCommand as Arguments
from .detection import Trial
from .results import stress_topics
from .trials import Trials, all_trials


def stress_twin(arguments: Arguments) -> int:
    """Run a twin with every fault, and print which are found."""
    twin = opened(arguments)
    if arguments.seeds < 1:
        raise ConfigError(f"--seeds {arguments.seeds}: must be 1 or more")
    if not arguments.duration > 0:
        raise ConfigError(f"--duration {arguments.duration:g}: must be positive")
    names = list(dict.fromkeys(arguments.estimators or (twin.estimator,)))
    for name in names:
        find_estimator(name, twin.model)
    prepare(twin)
    chosen = [
        (k, item)
        for k, item in enumerate(Trials(twin, arguments.duration).mistakes)
        if not arguments.only or any(text.lower() in item.key for text in arguments.only)
    ]
    mistakes = [item for _, item in chosen]
    if not mistakes:
        raise ConfigError(f"--only {' '.join(arguments.only)}: no mistake has that in its name; see --list")
    if arguments.list:
        names = [item.name for item in mistakes]
        print(to_json(names) if arguments.json else "\n".join(names))
        return 0
    found: dict[int, Trial | str] = {}
    title = f"{twin.name}, {len(mistakes)} mistakes"
    folds = len(mistakes) * len(names) * arguments.seeds
    overrides = overrides_of(arguments)
    ended = False
    with progress(title, folds, "folds") as advance:
        try:
            for k, trial in all_trials(
                arguments.twin, overrides, arguments.log, arguments.duration, chosen, names, arguments.seeds,
                jobs=arguments.jobs, cluster=arguments.cluster,
            ):  # fmt: skip
                found[k] = trial
                advance()
        except KeyboardInterrupt:
            if not found:
                raise
            ended = True
    trials = [trial for _, trial in sorted(found.items()) if isinstance(trial, Trial)]
    failed = [text for _, text in sorted(found.items()) if isinstance(text, str)]
    if ended:
        failed.append(f"interrupted after {len(found)} of {folds} folds")
        mistakes = [item for item in mistakes if any(trial.mistake == item.name for trial in trials)]
    for text in failed:
        complain(text)
    print(to_json(trials) if arguments.json else to_text(stress_topics(title, trials, mistakes)))
    return 130 if ended else 0
