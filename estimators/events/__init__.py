"""Events: their columns, the checks when they enter a log, arrays by name, and the guard of source clocks."""
