"""Learned corrections of a model, `correction` in a twin's YAML: read from a file, and what `nisus learn` does.

The mathematics are in estimators/model/correction.py.
"""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={"learn": Part(f"{__name__}.arguments:LearnCommand", f"{__name__}.learn:learn_correction")},
    corrections={"file": Part("", f"{__name__}.correction:correction_of")},
)
