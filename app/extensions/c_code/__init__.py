"""The filter of a twin as C99 for a controller: `nisus export TWIN --c`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={"export": Part(f"{__name__}.arguments:ExportCommand", f"{__name__}.export:export_filter")}
)
