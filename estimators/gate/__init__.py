"""The gate: reject or soften measurements far from their prediction, and decide about sensors that stay rejected."""
