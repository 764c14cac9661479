"""How each type of source is opened from its section of a twin's YAML: one file a type, and their registry."""
