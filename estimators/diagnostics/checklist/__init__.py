"""The checklist of a twin, measured: linearity, dimension, shape of the posterior, arrivals, sensors held out."""
