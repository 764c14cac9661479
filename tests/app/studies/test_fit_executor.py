"""Every fold of a fit is made in its executor, and any executor gives the same bits."""

from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from app.present.runs_json import fit_json
from estimators.fit.fit import fit
from estimators.fit.recording import Recording
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import MODEL, log_of, simulated


def bits(found):
    return repr(fit_json(found)), found.correlation.tobytes(), found.after.held_out.terms.tobytes()


def both_report():
    log = log_of(simulated(3, 300))
    log.add("silent", np.arange(300) + 0.5, simulated(4, 300))
    return log


class Counting(Executor):
    """Makes calls here, and counts them."""

    def __init__(self):
        self.calls = 0

    def map(self, fn, *iterables, timeout=None, chunksize=1):
        for items in zip(*iterables, strict=True):
            self.calls += 1
            yield fn(*items)


def test_every_fold_of_a_fit_is_made_in_its_executor():
    executor = Counting()
    options = {"wanted": ("Q", "R"), "considered": {"rate": 0.05, "offset": 1.0}}
    found = fit("kf", Tuning.of(MODEL), [Recording(both_report())], executor=executor, **options)
    assert found.widths is not None and len(found.after.held_out.sensors) == 2
    assert executor.calls == found.folds  # of one recording


def test_judgement_and_widths_in_processes_are_the_same_bits():
    options = {"considered": {"rate": 0.05, "offset": 1.0}}
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        found = fit("kf", Tuning.of(MODEL), [Recording(both_report())], executor=executor, **options)
    here = fit("kf", Tuning.of(MODEL), [Recording(both_report())], executor=None, **options)
    assert bits(found) == bits(here) and found.widths.envelope == here.widths.envelope
    assert found.widths.std.tobytes() == here.widths.std.tobytes()
