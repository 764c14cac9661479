"""The rows of a track as few points, for charts: columns by name, levels of detail, one fold's worth of them."""
