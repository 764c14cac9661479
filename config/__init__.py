"""Definition of twins: YAML schema and loader, bundled twins and their DBC files."""
