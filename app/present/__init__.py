"""Results as text, HTML, SVG and JSON, and what charts draw."""
