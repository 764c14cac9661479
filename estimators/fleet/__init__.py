"""Many assets of one model, folded by one compiled call."""
