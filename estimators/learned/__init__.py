"""Learning a correction of a model from recordings; what one is stands in model/correction.py and model/hybrid.py."""
