"""TDMS files of LabVIEW as tables, read by npTDMS."""

from config.extensions import Extension, Part

EXTENSION = Extension(tables={".tdms": Part("", f"{__name__}.groups:GROUPS")})
