"""Publishers: the outputs of a twin, alerts, and their receivers."""
