"""What a twin is: the schema of its YAML, the loader, the twins that ship and their DBC files."""
