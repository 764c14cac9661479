"""Bags of ROS 2, MCAP or SQLite: recordings of a twin, and its estimates from `nisus fold --out`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    tables=dict.fromkeys((".mcap", ".db3"), Part("", f"{__name__}.bag:BAG")),
    folders={"metadata.yaml": Part("", f"{__name__}.bag:files_in")},
    tracks={".mcap": Part("", f"{__name__}.bag_file:bag_writer")},
)
