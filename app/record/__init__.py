"""Recordings: their format, the writer and the reader."""
