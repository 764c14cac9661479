"""Archive of running twins in Parquet files, `--archive FOLDER`, and SQL over it: `nisus query`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={"query": Part(f"{__name__}.arguments:QueryCommand", f"{__name__}.query:query")},
    archives={"rows": Part("", f"{__name__}.writer:archive_of")},
)
