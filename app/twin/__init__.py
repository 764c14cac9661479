"""A twin put together from its YAML."""
