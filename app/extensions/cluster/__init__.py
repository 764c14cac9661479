"""Work on a Dask cluster: `--cluster ADDRESS`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    executors={
        "calls": Part("", f"{__name__}.workers:dask"),
        "folds": Part("", f"{__name__}.executor:folds_of"),
    }
)
