"""Runs compared: what each revision was worth, how two differ, and what the data say of a knob."""
