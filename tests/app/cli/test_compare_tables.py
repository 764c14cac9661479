"""The scores of the twins that ship: a row for every filter that applies, and what the filters do."""

import math
import re
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest

from app.study.compare import able, draws, outcome_of, timed, within, without_marks
from app.study.scores import COST, SPAN, read_scores, spread
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from config.loader import shipped
from estimators.registry import ESTIMATORS, unfit
from tests.skips import recorded

SEED = 1234
"""Not among the table's 0 to 7."""

SECONDS = 0.4
"""A filter that draws, or is plain Python, is folded again if its table says that it takes no longer."""

LEAST = 0.5
"""Spread of a share in per cent at least: near 100 it is skewed, and eight seeds may show none at all."""

SIGMA = 5.0 * math.sqrt(1 + 1 / 8)
"""Standard deviations between a new seed's figure and the mean of eight, five if the spread were known exactly."""


def refold(twin, estimator, events, seed=0):
    """The figures of one filter folded over all the events."""
    fold, seconds = timed(able(twin, estimator), estimator, events, seed, np.inf, enough=0.0)
    found = outcome_of(fold, events, seconds)
    errors = {f"RMSE [{unit}]": error.value for unit, error in found.rmse.items()}
    return {**errors, "mean NIS": found.nis.value, "in band [%]": 100.0 * found.coverage.value}


HUGE = ("thermal_field_large",)
"""Twins with no quick filter, whose log takes long: only its length is compared."""


class ScoreCell(NamedTuple):
    """A figure as it is printed: value, spread (NaN if there is none), and half a unit of the last digit."""

    value: float
    spread: float
    rounding: float


def read_cell(line, title):
    if not line[title]:
        return ScoreCell(np.nan, np.nan, np.nan)
    decimals = len(line[title].partition(".")[2])
    return ScoreCell(float(line[title]), float(line[spread(title)] or "nan"), 0.5 * 10.0**-decimals)


def read_span(line):
    """The seconds of the log that a row covers; None means all."""
    return float(line[SPAN]) if line[SPAN] else None


@lru_cache(maxsize=1)
def twin_and_events(name):
    twin, log = recorded(name)
    return twin, without_marks(log.events)


def quick(estimator, cells, events):
    entry = ESTIMATORS[estimator]
    seconds = 1e-6 * float(cells[COST]) * len(within(events, read_span(cells)))
    return seconds < SECONDS or not (draws(entry) or entry.interpreted)


def scores_of(twin):
    return {cells["filter"]: cells for cells in read_scores(twin.path)}


def mismatches(twin, events, rows):
    """Figures of the quick filters that are not those of a new fold."""
    wrong = []
    for estimator, cells in rows.items():
        if not cells[COST] or not quick(estimator, cells, events):
            continue
        random = draws(ESTIMATORS[estimator])
        span = read_span(cells)
        for title, value in refold(twin, estimator, within(events, span), SEED if random else 0).items():
            # Within a short span the errors hang together: the share in the band is that of one draw, all or nothing,
            # and the spread of eight says little of a ninth.
            if random and span is not None and title == "in band [%]":
                continue
            cell = read_cell(cells, title)
            # Rounding to the printed digit, and as much again for a spread that was rounded too.
            if np.isnan(cell.value) and np.isnan(value):
                continue
            scatter = max(cell.spread + cell.rounding, LEAST if title == "in band [%]" else 0.0)
            bound = SIGMA * scatter + cell.rounding if random else 1.001 * cell.rounding
            if not abs(value - cell.value) <= bound:
                wrong.append(f"{estimator}: {title} is {cells[title]} in the scores and {value:.6g} now")
    return wrong


@pytest.mark.parametrize("name", shipped())
def test_every_filter_that_applies_has_a_row(name):
    twin = load_twin(name)
    rows = scores_of(twin)
    assert list(rows) == [key for key, entry in ESTIMATORS.items() if unfit(entry, able(twin, key).model) is None]
    for estimator, cells in rows.items():
        options = [f"{option}={value:g}" for option, value in twin.options_of(estimator).items()]
        assert cells["options"].split() == options, f"{estimator}: options are now {options}"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.release if name in HUGE else ()) for name in shipped()]
)
def test_the_scores_say_what_the_filters_do(name):
    """To the last printed digit, or for filters that draw, as near as another seed comes."""
    twin, events = twin_and_events(name)
    rows = scores_of(twin)
    assert {int(cells["events"]) for cells in rows.values()} == {len(events)}
    wrong = mismatches(twin, events, rows)
    assert not wrong, "; ".join(wrong) + f": write them anew, nisus compare {name} --write"


@pytest.mark.parametrize("name", [name for name in shipped() if "Over 20 logs" in load_twin(name).text])
def test_other_logs_are_as_the_head_says(name):
    """Two logs of the simulator that are not among the twenty, folded by the twin's own filter."""
    text = load_twin(name).text
    said = re.search(r"Over 20 logs \(seeds (\d+) to (\d+), ([\w-]+)\): mean NIS (\S+), in band (\S+) %", text)
    assert said
    nis, band = ([float(number) for number in figure.split("±")] for figure in said.group(4, 5))
    for seed in (int(said[2]) + 1, int(said[2]) + 2):
        twin = load_twin(name, overrides={"source.seed": str(seed)})
        assert twin.estimator == said[3]
        found = refold(twin, twin.estimator, without_marks(read_log(twin, None)[0].events))
        assert abs(found["mean NIS"] - nis[0]) < SIGMA * nis[1]
        assert abs(found["in band [%]"] - band[0]) < SIGMA * max(band[1], LEAST)


def test_scores_that_are_no_longer_true_are_found():
    twin, events = twin_and_events("motor_winding")
    rows = scores_of(twin)
    for estimator in ("kf", "etkf"):
        for title in ("RMSE [°C]", "mean NIS", "in band [%]"):
            cell = read_cell(rows[estimator], title)
            step = 2 * cell.rounding if np.isnan(cell.spread) else 15 * cell.spread
            changed = {**rows[estimator], title: f"{cell.value + step:.9g}"}
            (wrong,) = mismatches(twin, events, {estimator: changed})
            assert wrong.startswith(f"{estimator}: {title} is {changed[title]}")
