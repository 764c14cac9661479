"""The page: its server, API and streams, and the gallery of twins."""
