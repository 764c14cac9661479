"""The one loopback port: the page, the API, and what is passed through."""
