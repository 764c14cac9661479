"""The filter of a twin as C99: formulas read from the model's functions, and the C code around them."""
