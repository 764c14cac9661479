"""Learned corrections of a model: training data from recordings, training, and judging, as `nisus learn` does it.

A twin with a correction does without this: app/twin/learned.py, estimators/model/correction.py.
"""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={"learn": Part(f"{__name__}.arguments:LearnCommand", f"{__name__}.learn:learn_correction")}
)
