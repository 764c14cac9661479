"""Events: what the asset said. Their columns, the checks at the log's door, their order, and arrays by name."""
