"""A model as machine code, and the context in which a filter sees it."""
