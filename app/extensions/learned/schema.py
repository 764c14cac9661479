"""Schema of the file of a learned correction, which holds its training windows, so that it can be computed anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from config.fields import NotNegative, Number, Positive, Positives, Section, Text, Texts, as_list, refused
from config.problems import check_section
from config.yaml_files import ValuePlaces, read_text

Table = Annotated[tuple[Annotated[tuple[Number, ...], Field(min_length=1)], ...], Field(min_length=2)]


class LearnedHeadSection(Section):
    """Origin and scores of a correction."""

    twin: Text
    """Name of the twin whose physics it corrects."""
    model: Text
    """Name of its model: states and inputs of another mean something else."""
    saved: Text
    """Time of saving, as 2026-11-22T10:30:00Z."""
    learned_on: Annotated[tuple[Text, ...], BeforeValidator(as_list, json_schema_input_type=str | list[str])] = ()
    """The recordings from which it was learned."""
    how: str = ""
    """How it was chosen."""
    scores: dict[str, Number] = {}
    """Scores on the held-out blocks: rmse.NAME, coverage.NAME, crps.NAME, nis, log_density, and
    the same of the physics alone under physics.*."""


class CorrectionSection(Section):
    """A correction of the rates of some states by features, learned from windows of recordings (nisus learn)."""

    learned: LearnedHeadSection
    """Origin and scores."""
    kind: Literal["gp", "ridge", "net"]
    """gp: a Gaussian process. ridge: ridge regression. net: a network of an ONNX file, which makes the model a black
    box."""
    corrects: Texts
    """The states whose rates are corrected."""
    features: Texts
    """States and inputs on which the correction depends."""
    noise: dict[str, NotNegative]
    """Variance that a second adds to each corrected state where there is no training data, in the square of its unit:
    the noise NAME_learned, which can be tuned like any other."""
    points: Table
    """The features of each window, in their units, in the order of `features`."""
    rates: Table | None = None
    """Error of the model's rate in each window, in units of the corrected states a second. Not for a net."""
    lengths: Positives | None = None
    """gp: the length scale of each feature, in its unit."""
    ratio: Positive | None = None
    """gp: variance of a window's noise over the variance of the correction."""
    penalty: Positive | None = None
    """ridge: penalty added to the diagonal of the normal equations, for standardised features."""
    degree: Literal[1, 2] = 1
    """ridge: 2 has products and squares of the features too. Default: 1."""
    net: Text | None = None
    """net: the ONNX file, beside this one. It takes features (N, d) and gives rates (N, k)."""

    @model_validator(mode="after")
    def _fits(self) -> CorrectionSection:
        needs = {"gp": ("rates", "lengths", "ratio"), "ridge": ("rates", "penalty"), "net": ("net",)}[self.kind]
        for key in needs:
            if getattr(self, key) is None:
                raise refused("absent", f"is of kind {self.kind} and has no {key}")
        for key, size in (("points", len(self.features)), ("rates", len(self.corrects))):
            wrong = next((row for row in getattr(self, key) or () if len(row) != size), None)
            if wrong is not None:
                raise refused("relation", f"has a row of {len(wrong)} numbers; each needs {size}", key)
        if self.rates is not None and len(self.rates) != len(self.points):
            raise refused("relation", f"has {len(self.rates)} rows; points has {len(self.points)}", "rates")
        if self.lengths is not None and len(self.lengths) != len(self.features):
            text = f"has {len(self.lengths)} numbers; it needs one for each of {len(self.features)} features"
            raise refused("relation", text, "lengths")
        if set(self.noise) != set(self.corrects):
            text = f"names {', '.join(self.noise) or 'nothing'}; it must name each corrected state, and no other"
            raise refused("relation", text, "noise")
        return self


def load_correction(path: Path) -> tuple[CorrectionSection, ValuePlaces]:
    """Read and check a correction's file.

    Raises:
        ConfigError: With a line for each of the first problems.
    """
    text = read_text(path, "nisus learn --help")
    section, _, places = check_section(CorrectionSection, text, path, "a correction is a mapping, see `nisus learn`")
    return section, places
