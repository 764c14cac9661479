"""A twin put together: its YAML, model, tuning and source."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from config.companion_schema import TuningSection
from config.loader import Loaded, load, load_text
from config.old_names import new_overrides
from config.schema import TwinSection
from config.source_schema import AssetSection
from config.tunings import OWN_VALUES, Version, find_version
from config.yaml_files import baseline_file, parse
from estimators.diagnostics.episodes.baseline import baseline_of, lost_from
from estimators.diagnostics.health import HealthPolicy
from estimators.errors import LARGEST, ConfigError, EstimatorError
from estimators.fold import Fold
from estimators.fold_checks import check_variances
from estimators.log import Log
from estimators.model.state_space import StateSpaceModel
from estimators.registry import checked, find_entry, find_estimator
from estimators.tuning import CHANGED_MARK, Tuning
from sources.source import Report, Source

from .checks import check_named, check_names, check_outputs, check_refit, check_scene, commissioned
from .defaults import DegradedAfter, Late, degraded_after, driven_states, late_policy, parameter_sections
from .ingest import Planned, UnknownInputs
from .landmarks import expanded
from .model import configure, find_model, model_files
from .source import Plan, plan_source

VERSION = "tuning"
"""The key among the overrides that names a tuning version."""


@dataclass(frozen=True)
class Twin:
    """A configured model, the first tuning, and the plan of its source.

    `pairs` (k, 2) holds the indices of the states whose ellipses are drawn. `overrides` are the command line's
    changes to the YAML, which `text` holds as it was read. `recorded`: tuning and estimator come from a recording.
    """

    loaded: Loaded
    model: StateSpaceModel
    tuning: Tuning
    estimator: str
    pairs: np.ndarray
    overrides: Mapping[str, str]
    plan: Plan
    recorded: bool = False

    @property
    def config(self) -> TwinSection:
        """The checked configuration, with defaults filled in."""
        return self.loaded.config

    @property
    def path(self) -> Path:
        """The YAML file."""
        return self.loaded.path

    @property
    def text(self) -> str:
        """The YAML as it was read."""
        return self.loaded.text

    @property
    def version(self) -> Version | None:
        """The tuning version whose values stand in place of the YAML's; None for none."""
        return self.loaded.version

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the twin: its YAML, its baseline, its tuning version, the user's of its model and correction."""
        version = () if self.version is None else (self.version.path,)
        return (self.path, baseline_file(self.path), *version, *model_files(self.loaded))

    @property
    def name(self) -> str:
        """Short name."""
        return self.config.name or self.path.stem

    @property
    def title(self) -> str:
        """One line for the top of the page."""
        return self.config.title or self.model.title

    @property
    def picture(self) -> float | None:
        """Seconds between two pictures of a large field; None if there is none."""
        view = self.config.view
        return (view.picture or view.window / 60.0) if self.model.grid is not None else None

    @property
    def maintenance(self) -> tuple[Planned, ...]:
        """Maintenance of the asset by the YAML."""
        names = self.model.state_names
        return tuple(
            Planned(round(item.at * 1e9), item.what, tuple(sorted(names.index(name) for name in item.states)))
            for item in self.config.maintenance
        )

    @property
    def unknown_inputs(self) -> UnknownInputs | None:
        """Pauses of the source over which the inputs are unknown; None if they are held for however long."""
        after = self.config.time.paused_after
        return None if after is None else UnknownInputs(round(after * 1e9), driven_states(self.model))

    @property
    def policy(self) -> HealthPolicy:
        """When the estimate may be trusted."""
        return HealthPolicy(
            degraded_after=self.degraded.seconds,
            stale_after=self.config.time.stale_from(self.degraded.seconds),
            diverged_nis=lost_from(commissioned(self.loaded, self.model)),
        )

    @cached_property
    def late(self) -> Late:
        """Treatment of late measurements, with the reason."""
        return late_policy(self.config, self.model, find_estimator(self.estimator, self.model), self.tuning)

    @cached_property
    def degraded(self) -> DegradedAfter:
        """After how long without a reading the twin is degraded, and why then."""
        return degraded_after(self.config, self.model, lambda: self.plan.period)

    @property
    def expected(self) -> np.ndarray:
        """Whether a sensor without a measurement is an alarm, (sensors,): those that a bus or a simulation feeds.

        In a recording a sensor may start later; a column without any value is reported at the end of the file.
        """
        return np.isin(np.arange(len(self.model.sensors)), () if self.plan.recorded else self.plan.fed)

    @property
    def forced_baseline(self) -> str:
        """Why the log of its baseline contradicted it, if it was accepted with --force; "" otherwise."""
        return next((item.forced for item in self.config.baseline.values() if item.forced), "")

    @property
    def tells_field(self) -> bool:
        """Whether the source provides the true state of a whole large field."""
        grid, source = self.model.grid, self.config.source
        if grid is None:
            return False
        if isinstance(source, AssetSection):
            return source.truth.every is not None
        return any(grid.name in getattr(part, "truth", {}) for part in getattr(source, "parts", (source,)))

    @property
    def kernels(self) -> tuple[str, ...]:
        """What its source compiles (`sources/pieces.py`); a recording that is reviewed is no source."""
        return () if self.recorded else self.plan.kernels

    def fold(self, log: Log | None = None, **options: Any) -> Fold:
        """Return a fold of a log, by default of an empty one, that has not begun; for the options see `Fold`."""
        return Fold(self.estimator, self.model, self.tuning, Log.of(self.model) if log is None else log, **options)

    def check_files(self) -> None:
        """Open the files of its source, and close them, before anything is compiled for it.

        Raises:
            SourceError: If one is absent or does not fit.
        """
        if not self.recorded:
            self.plan.check_files()

    def options_of(self, estimator: str) -> Mapping[str, float]:
        """Return the YAML's options of an estimator; choices as their numbers."""
        return _options(self.config, estimator)

    def open_source(self, report: Report, **options: Any) -> Source:
        """Open the source, behind its faults; see `Plan.open`."""
        return self.plan.open(report, **options)


def load_twin(
    name_or_path: str | os.PathLike[str],
    *,
    log_files: Sequence[str | os.PathLike[str]] | None = None,
    overrides: Mapping[str, str] | None = None,
) -> Twin:
    """Put a twin together.

    Args:
        name_or_path: Name of a twin that ships, or path of a YAML file.
        log_files: Recordings to read instead of the twin's own.
        overrides: The command line's `--set KEY=VALUE`: a tuning key (Q.temperature), or a dotted key of the YAML; and
            under `tuning` the name of a tuning version.

    Raises:
        ConfigError: If the YAML, the version or an override breaks a rule.
        ModelError: If the model's file fails.
    """
    overrides = new_overrides(overrides or {}, tell=True)
    named = {key: value for key, value in overrides.items() if key == VERSION}
    return _assemble(load(name_or_path, _of_yaml(overrides) | named), overrides, log_files)


def restore_twin(
    text: str,
    base_path: str | os.PathLike[str],
    overrides: Mapping[str, str] | None = None,
    version: Version | None = None,
) -> Twin:
    """Put a twin together from the YAML text that a recording holds; `base_path` is where its file was.

    `version` is its tuning version; a version named in `overrides` is not loaded again.

    Raises:
        ConfigError: If the YAML breaks a rule.
        ModelError: If the model's file fails, or is no longer there.
    """
    overrides = new_overrides(overrides or {})
    return _assemble(load_text(text, Path(base_path), _of_yaml(overrides), version), overrides, None)


def with_version(twin: Twin, reference: str) -> Twin:
    """Return the same twin under another tuning version, or under its own file (`own`).

    Changes of the tuning by the command line or the page are dropped; other overrides stay.

    Raises:
        ConfigError: If there is no such version, or it breaks a rule.
    """
    known = _of_yaml(twin.overrides)
    kept = {key: value for key, value in known.items() if key.split(".")[0] not in TuningSection.model_fields}
    version = find_version(twin.path, reference)
    named = {} if version is None else {VERSION: reference}
    return _assemble(load_text(twin.text, twin.path, kept, version), kept | named, twin.plan.log_files)


def with_held(twin: Twin) -> Twin:
    """Return the twin with every considered parameter held, as a fit needs it: its data are to say the widths."""
    if not twin.model.considered:
        return twin
    parameters = {
        name: section.model_copy(update={"role": "held"}) if section.role == "considered" else section
        for name, section in parameter_sections(twin.model, twin.config).items()
    }
    loaded = replace(twin.loaded, config=twin.config.model_copy(update={"parameters": parameters}))
    found, loaded = expanded(find_model(loaded, ("model",), loaded.config.model), loaded)
    model = configure(found, loaded)
    return replace(twin, loaded=loaded, model=model, tuning=replace(twin.tuning, model=model))


def _of_yaml(overrides: Mapping[str, str]) -> dict[str, str]:
    """Return the overrides that change the YAML; the others are keys of the tuning."""
    return {key: value for key, value in overrides.items() if key.split(".")[0] in TwinSection.model_fields}


def _assemble(loaded: Loaded, overrides: Mapping[str, str], log_files: Sequence[str | os.PathLike[str]] | None) -> Twin:
    found = find_model(loaded, ("model",), loaded.config.model)
    _check_version(loaded, found)
    asset = None if loaded.without is None else expanded(found, loaded.without)
    found, loaded = expanded(found, loaded)
    config = loaded.config
    model = configure(found, loaded)
    for name, given in config.filters.items():
        _check_options(loaded, ("filters", name), name, given, model)
    first = config.estimator
    with _placed(loaded, ("estimator",)):
        entry = find_estimator(first.name, model)
    _check_options(loaded, ("estimator", "options"), first.name, first.options, model)
    normals = commissioned(loaded, model)
    tuning = replace(Tuning.of(model), baseline=baseline_of(model, normals) if normals else None)
    tuning = tuning.with_options(_options(config, first.name))
    if config.gate is not None:
        tuning = tuning.set("gate", config.gate.probability).set("gate.kind", config.gate.kind)
        tuning = tuning.set("gate.reopen", config.gate.seconds)
    for name, section in config.sensors.items():
        if not section.use:
            tuning = tuning.set(f"use.{name}", False)
    turned = {key: value for key, value in overrides.items() if key not in _of_yaml(overrides) and key != VERSION}
    for key, value in turned.items():
        tuning = _set(tuning, key, value)
    name = OWN_VALUES if loaded.version is None else loaded.version.name
    changed = bool(turned) or any(key.split(".")[0] in TuningSection.model_fields for key in overrides)
    tuning = replace(tuning, name=name + (CHANGED_MARK if changed else ""))
    check_refit(loaded, first.name, tuning)
    check_outputs(loaded, model)
    if config.time.paused_after is not None and not driven_states(model):
        raise loaded.error(("time", "paused_after"), f"is for inputs, and none drives {model.name}; leave it out")
    for k, item in enumerate(config.maintenance):
        check_names(loaded, ("maintenance", k, "states"), item.states, model.state_names, "state", model)
        if len(set(item.states)) != len(item.states):
            raise loaded.error(("maintenance", k, "states"), "names a state twice; name each once")
    believed = (loaded, model) if asset is None else (asset[1], configure(*asset))
    plan = plan_source(*believed, [Path(file) for file in log_files] if log_files else None)
    if plan.brings_variances:
        with _placed(loaded, ("estimator",)):
            check_variances(entry, entry.complete(tuning.options))
    if config.time.late == "inflate":
        with _placed(loaded, ("time", "late")):
            check_variances(entry, entry.complete(tuning.options))
    return Twin(
        loaded=loaded,
        model=model,
        tuning=tuning,
        estimator=first.name,
        pairs=_pairs(loaded, model),
        overrides=overrides,
        plan=plan,
    )


def _check_version(loaded: Loaded, model: StateSpaceModel) -> None:
    """Refuse a tuning version of another model."""
    version = loaded.version
    if version is not None and version.head.model != model.name:
        raise ConfigError(
            f"{version.places.at(('version', 'model'))}: version.model is {version.head.model!r}; the model of "
            f"{loaded.path.stem} is {model.name!r}, to which its values mean nothing; choose another version"
        )


def _options(config: TwinSection, estimator: str) -> dict[str, float]:
    """Return the options given for an estimator, with words of choices as their numbers."""
    first = config.estimator
    given = {**config.filters.get(estimator, {}), **(first.options if estimator == first.name else {})}
    values = find_entry(estimator).complete(given)
    return {name: values[name] for name in given}


def _check_options(
    loaded: Loaded, key: tuple[str, ...], name: str, given: Mapping[str, float | str], model: StateSpaceModel
) -> None:
    """Refuse options, given under `key`, that the estimator of that name cannot run with; each has its own line."""
    with _placed(loaded, key):
        entry = find_entry(name)
    for option, value in given.items():
        with _placed(loaded, (*key, option)):
            checked(entry, model, {option: value})


@contextmanager
def _placed(loaded: Loaded, key: tuple[str, ...]) -> Iterator[None]:
    """Name the place in the YAML in errors of an estimator."""
    try:
        yield
    except EstimatorError as error:
        raise ConfigError(f"{loaded.places.at(key)}: {error}") from None


def _set(tuning: Tuning, key: str, text: str) -> Tuning:
    option = f"--set {key}={text}"
    try:
        value, _ = parse(text, option)
    except ConfigError:
        value = text
    wants_bool = key.startswith("use.")
    tuning_keys = tuning.keys()
    if key in tuning_keys and (not isinstance(value, (int, float)) or isinstance(value, bool) != wants_bool):
        raise ConfigError(f"{option}: {key} must be {'true or false' if wants_bool else 'a number'}")
    try:
        return tuning.set(key, value if key in tuning_keys else None)
    except OverflowError:
        raise ConfigError(f"--set {key}: {key} is too large; it must be {LARGEST:g} at most") from None
    except ConfigError as error:
        more = "" if key in tuning_keys else f"; or a key of the YAML: {', '.join(TwinSection.model_fields)}"
        raise ConfigError(f"{option}: {error}{more}") from None


def _pairs(loaded: Loaded, model: StateSpaceModel) -> np.ndarray:
    """Indices of the pairs of states in the view; the scene's names are checked on the way."""
    view = loaded.config.view
    check_scene(loaded, model)
    if view.pairs is None and model.grid is not None:
        return np.zeros((0, 2), int)
    if view.pairs is None:
        return np.array([[0, 1]] if model.nx > 1 else np.zeros((0, 2)), int)
    for k, pair in enumerate(view.pairs):
        check_named(loaded, ("view", "pairs", k), pair, model)
        if pair[0] == pair[1]:
            raise loaded.error(("view", "pairs", k), f"names {pair[0]} twice; an ellipse needs two states")
        for name in pair:
            if model.state_names.index(name) not in model.shown:
                raise loaded.error(("view", "pairs", k), f"names {name}, which is not among view.cells; add it there")
    return np.array([[model.state_names.index(name) for name in pair] for pair in view.pairs], int).reshape(-1, 2)
