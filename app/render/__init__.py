"""A run as text, HTML, JSON or a table in a file."""
