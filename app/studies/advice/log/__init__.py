"""A bare recording: what it holds, what belongs together in it, and how each signal moves. No model is needed."""
