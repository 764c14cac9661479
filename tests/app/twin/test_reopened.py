"""A twin that ships and whose gate closes on its position for good: a second story opens it."""

import numpy as np

from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.track import GATED
from tests.support import folded


def test_a_second_story_doubts_no_sensor():
    """The reading whose story it is, and those that follow it, are let in: 421 are refused in all. A story that took
    over the doubt of the first would refuse the same readings again, and be told for nothing.

    With the `ukf`, which takes contact for a number and is wrong at every touch, so that its gate refuses the finger.
    Whether a second story then opens the gate depends on the recording; with the noise of seed 11 one does.
    """
    twin = load_twin("gripper_contact", overrides={"source.seed": "11"})
    log, _ = read_log(twin, None)
    tuning = twin.tuning.with_options(twin.options_of("ukf"))
    whole = folded("ukf", twin.model, log, tuning, pairs=twin.pairs, policy=twin.policy)
    assert np.sum(whole.track.verdict == GATED) == 421
    assert [item.outcome for item in whole.decisions] == [
        *("doubted", "isolated", "agrees", "doubted", "reopened", "doubted", "agrees")
    ]
