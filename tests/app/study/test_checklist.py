"""Advice of the checklist: it follows from what a filter does, and names filters that exist and apply."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.study.checklist import QUESTIONS
from estimators.diagnostics.sensitivity.checklist import Linearity
from estimators.diagnostics.sensitivity.posterior import Peaks
from estimators.diagnostics.sensitivity.responses import stand_in
from estimators.fold import Fold
from estimators.log import READING
from estimators.registry import ESTIMATORS, unfit
from estimators.tuning import Tuning
from tests.models import first_state_squared, level_model
from tests.support import log_of

R = 0.04


MODEL = level_model({"square": R}, 1e-12, h=first_state_squared)
FILTERS = [name for name, entry in ESTIMATORS.items() if unfit(entry, MODEL) is None]


def run(name, tuning):
    found = Fold(name, MODEL, tuning, log_of(1, (1, READING, [0.5], 0)))
    found.advance()
    return found


@pytest.fixture(params=FILTERS, scope="module")
def folded(request):
    """One reading of x² where its slope is zero: with its curvature E x² is P, without it 0."""
    return run(request.param, Tuning.of(MODEL))


def remedy(key, found):
    """Return the remedy of a log whose f and h bend and whose clouds have two peaks."""
    checked = SimpleNamespace(
        twin=SimpleNamespace(estimator=found.estimator.name, tuning=found.tuning), fold=found, tails=(),
        linearity=Linearity("", False, False, True, (), (), (), "bends"), peaks=Peaks("pf", "", 9, 1.0, 2, 0, 1.0),
    )  # fmt: skip
    return next(answer for name, _, answer in QUESTIONS if name == key)(checked)[2]


def test_only_a_filter_that_linearises_is_told_of_the_curvature(folded):
    misses = folded.track.innovation[0, 0] == pytest.approx(0.5, abs=1e-9)
    assert ("ukf or ckf see the curvature" == remedy("linearity", folded)) == misses


def test_filters_with_several_peaks_are_those_that_exist_and_apply(folded):
    said = remedy("posterior", folded)
    if "particles" in dict.fromkeys(option.name for option in folded.estimator.options):
        assert said == "particles carry the peaks"
    else:  # rbpf needs a model that is conditionally linear
        assert said.endswith("has one peak: use pf, pf-reg, pf-ekf, apf")


def test_a_filter_that_draws_is_replaced_where_it_is_nudged(folded):
    """Its estimate changes with the seed."""
    name = folded.estimator.name
    other = run(name, replace(folded.tuning, seed=1))
    drawn = not np.array_equal(other.track.std, folded.track.std)
    assert stand_in(name, MODEL)[0] == ("ekf" if drawn else name)
