"""Numbers without a model: compiling, dense linear algebra, random numbers, vector instructions."""
