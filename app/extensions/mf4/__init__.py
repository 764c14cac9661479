"""MDF files (.mf4, .mdf, .dat) with signals as tables, read by asammdf."""

from config.extensions import Extension, Part
from sources.formats import MDF

EXTENSION = Extension(tables=dict.fromkeys(MDF, Part("", f"{__name__}.signals:SIGNALS")))
