"""Tuning versions in files beside a twin: write, accept, list and load them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from config.companion_schema import AcceptedSection, EvidenceSection, MovedSection, VersionSection
from config.loader import moved
from config.old_names import rewrite
from config.tunings import OWN_VALUES, Version, check_name, folders, load_version, version_files, version_of
from config.yaml_files import as_section, rounded, shown_path, with_section, writing
from estimators.diagnostics.health import PROBABILITY
from estimators.diagnostics.score import Fit, Score
from estimators.errors import LARGEST, ConfigError
from estimators.registry import find_estimator
from estimators.tuning import Tuning

from ..result import JsonObject
from .tuning_yaml import tuning_yaml, with_spread, with_tuning
from .twin import Twin

if TYPE_CHECKING:
    from estimators.fit.fit import Fitted
    from estimators.fit.judge import PartScore, PredictionScore
    from estimators.fit.uncertainty import ParameterWidths

NIS, LIKELIHOOD, RMSE, COVERAGE, REFUSED = "nis", "log_likelihood", "rmse", "coverage", "refused"

VERDICT_FILE = "guard.json"  # name of the file with the last verdicts, in the folder of the tuning versions

DIGITS = 8
"""Significant digits of a score, more than differ between processors."""


@dataclass(frozen=True)
class Settings:
    """Filter, tuning, scores and evidence of a version.

    `prior` is the mean and covariance of a fitted one; `scores` are those of `figures`; `evidence` and `widths` are
    those of a fit.
    """

    estimator: str
    tuning: Tuning
    note: str = ""
    fitted_on: Sequence[str] = ()
    scores: Mapping[str, float] = field(default_factory=dict)
    prior: tuple[np.ndarray, np.ndarray] | None = None
    model_version: int = 1
    evidence: EvidenceSection | None = None
    widths: ParameterWidths | None = None


def write_section(path: Path, key: str, section: str) -> None:
    """Replace the section `key` of a YAML file by these lines, or append them; the other text stays.

    Raises:
        ConfigError: If the file cannot be written.
    """
    rewrite(path, lambda text: with_section(text, key, section), path)


def listing(twin: Twin) -> list[JsonObject]:
    """Return the twin's own settings and its versions, the oldest first.

    Each has `name`, `estimator`, `holds` (whether guards use it) and the head of its file; a file that cannot be read
    has `name` and `error`.
    """
    versions: list[Version] = []
    broken: list[JsonObject] = []
    for name, path in version_files(twin.path).items():
        try:
            versions.append(load_version(path))
        except ConfigError as error:
            broken.append({"name": name, "error": str(error)})
    versions.sort(key=lambda version: (version.head.saved, version.name))
    accepted = last_accepted(versions)
    own = twin.loaded.without or twin.loaded
    found: list[JsonObject] = [{"name": OWN_VALUES, "estimator": own.config.estimator.name, "holds": accepted is None}]
    for version in versions:
        estimator = version.section.estimator or own.config.estimator
        head = version.head.model_dump(mode="json")
        found.append({"name": version.name, "estimator": estimator.name, "holds": version is accepted, **head})
    return found + broken


def last_accepted(versions: Iterable[Version]) -> Version | None:
    """Return the version that was accepted last; None if the twin's own file is in use."""
    accepted = [version for version in versions if version.head.accepted is not None]
    return max(accepted, key=lambda version: version.head.accepted.at, default=None)  # type: ignore[union-attr]


def figures(found: Score) -> dict[str, float]:
    """Return the finite figures of a score; without truth or a held-out sensor there is no RMSE.

    Returns:
        `nis` per degree of freedom, `log_likelihood` per measurement, `refused` (a share), and for each state whose
        truth is known and each sensor row held out `rmse.NAME` in its unit and `coverage.NAME` as a share; `rmse.field`
        for all cells of a large field.
    """
    fits = {**found.states, **found.held_out, **({"field": found.field} if found.field is not None else {})}
    known = {
        NIS: found.nis_verdict.ratio,
        LIKELIHOOD: found.log_likelihood_reading,
        REFUSED: found.refused,
        **_fits(fits, "rmse"),
    }
    return _finite(known)


def badness(name: str, value: float) -> float:
    """Return how bad a figure is; more is worse.

    The logarithm of an RMSE, the distance of the logarithm of the NIS from 0 and of a coverage from 95 %; the
    likelihood negated, others as they are. A change of 0.05 is 5 % of an RMSE, 5 % of the NIS, 5 of 100 errors, 5 % of
    the density of a measurement.
    """
    kind = name.partition(".")[0]
    if kind in (RMSE, NIS):
        size = float(np.log(max(value, np.finfo(float).tiny)))
        return size if kind == RMSE else abs(size)
    if kind == COVERAGE:
        return abs(value - PROBABILITY)
    return -value if kind == LIKELIHOOD else value


def _finite(known: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in known.items() if np.isfinite(value)}


def _fits(items: Mapping[str, Fit | PredictionScore], rms: str) -> dict[str, float]:
    """Return RMSE (the field `rms`) and coverage of each item."""
    errors = {f"{RMSE}.{name}": getattr(item, rms) for name, item in items.items()}
    return errors | {f"{COVERAGE}.{name}": item.coverage for name, item in items.items()}


def version_text(twin: Twin, given: Settings) -> str:
    """Return the YAML of a version."""
    head = VersionSection(
        twin=twin.name,
        model=twin.model.name,
        model_version=given.model_version,
        saved=now(),
        note=given.note,
        fitted_on=tuple(given.fitted_on),
        scores=rounded(dict(given.scores), DIGITS),
        evidence=given.evidence,
    )
    heading = f"# A tuning version of {twin.name}; `nisus tunings` lists, compares and accepts them.\n"
    baseline = {} if given.tuning.baseline is None else twin.config.baseline
    normal = {name: section.model_dump(mode="json", exclude_unset=True) for name, section in baseline.items()}
    more = (*as_section("withhold", twin.config.withhold), *as_section("baseline", normal))
    values = tuning_yaml(twin.config, given.estimator, given.tuning, given.prior, whole=False, widths=given.widths)
    return heading + _header(head) + values + "".join(f"{line}\n" for line in more)


def check_free(twin: Path, name: str) -> Path:
    """Return the file for a version of this name, beside a twin's YAML.

    Raises:
        ConfigError: If the name is none or taken.
    """
    path = folders(twin)[0] / f"{check_name(name)}.yaml"
    if path.exists():
        raise _taken(path)
    return path


def _taken(path: Path) -> ConfigError:
    return ConfigError(f"{shown_path(path)}: there is a version of that name; choose another name")


def keep(twin: Twin, name: str, text: str) -> Path:
    """Write a version beside its twin; return the file.

    Raises:
        ConfigError: If the name is none or taken, the text is wrong, or the file cannot be written.
    """
    path = check_free(twin.path, name)
    version_of(name, text, path)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(text)
        except FileExistsError:
            raise _taken(path) from None
    return path


def apply_tuning(
    twin: Twin,
    estimator: str,
    tuning: Tuning,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    widths: ParameterWidths | None = None,
    out: Path | None = None,
) -> str:
    """Write a tuning into the YAML of a twin, or into the copy `out`; return what was written, in words.

    The twin is as its file has it. `prior` (mean and covariance) and `widths` (of the parameters) are those of a fit.

    Raises:
        ConfigError: If it cannot be written.
    """
    before = tuning_yaml(twin.config, twin.estimator, twin.tuning)
    after = tuning_yaml(twin.config, estimator, tuning, prior, widths=widths)
    path = twin.path
    kept = rewrite(path, lambda text: moved(with_tuning(text, before, after), path, out or path), out)
    words = f"{shown_path(out or twin.path)}: has the values"
    if widths is not None and (spread := with_spread(twin.config, tuning.model, widths)):
        several = not np.array_equal(widths.spread, widths.prior)
        words += f"; std of {', '.join(spread)} {'between the logs' if several else 'as before: one log, one specimen'}"
    return words if kept is None else f"{words}; the previous file is {shown_path(kept)}"


def accept(version: Version, note: str) -> None:
    """Note in a version's file that it is accepted; raises as `write_section`."""
    head = version.head.model_copy(update={"accepted": AcceptedSection(at=now(), note=note)})
    write_section(version.path, "version", _header(head))
    load_version(version.path)


def now() -> str:
    """Return the present time in the format of versions."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def verdicts(twin: Path) -> list[JsonObject]:
    """Return the last verdict of `nisus guard` on each recording, newest first; none if the file is damaged or missing.

    Each has `recording`, `at` (UTC), `version` (tuning), `figures` (number), `worse` and `better` (a line each) and
    `failure`, empty unless it could not be folded.
    """
    try:
        found = json.loads((folders(twin)[0] / VERDICT_FILE).read_text(encoding="utf-8"))["recordings"]
        return sorted(found, key=lambda each: (each["at"], each["recording"]), reverse=True)
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _header(head: VersionSection) -> str:
    given = head.model_dump(mode="json", exclude_defaults=True)
    return "".join(f"{line}\n" for line in as_section("version", given))


def widths_of(twin: Twin, found: Fitted) -> ParameterWidths | None:
    """Return the widths of the parameters of a fit; None if its filter cannot consider them."""
    return found.widths if find_estimator(found.estimator, twin.model).considers else None


def settings_of(twin: Twin, found: Fitted, fitted_on: Sequence[str], note: str = "") -> Settings:
    """Return filter, tuning, widths and held-out scores of a fit of these recordings, with the note of a version."""
    tuning, prior = found.setting
    return Settings(
        found.estimator,
        tuning,
        note,
        tuple(fitted_on),
        _scores(found.after.held_out),
        prior,
        evidence=_evidence(found) if found.proposed else None,
        widths=widths_of(twin, found),
    )


def _scores(part: PartScore) -> dict[str, float]:
    predicted = {**part.sensors, **part.withheld, **part.states}
    return _finite({NIS: part.nis, LIKELIHOOD: part.log_density, **_fits(predicted, "rms")})


def _evidence(found: Fitted) -> EvidenceSection:
    from estimators.fit.dual import shift

    def digits(value: float) -> float | None:
        return rounded(value) if np.isfinite(value) and abs(value) <= LARGEST else None

    entries = {
        line.key: MovedSection(
            before=line.before,
            after=line.after,
            low=digits(line.low),
            high=digits(line.high),
            sigma=digits(shift(line)) or 0.0,
        )
        for line in found.lines
        if not line.alone
    }
    before = rounded(_scores(found.before.held_out), DIGITS)
    gain, error = digits(found.verdict.gain) or 0.0, digits(found.verdict.error) or 0.0
    return EvidenceSection(gain=gain, error=error, before=before, entries=entries)
