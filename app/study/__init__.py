"""Studies: from a twin and a log to a result; they know neither a terminal nor a running twin."""
