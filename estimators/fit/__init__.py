"""Fitting a tuning to recorded logs: which entries, by what they are judged, how sure the data are of them."""
