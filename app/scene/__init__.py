"""Viser: the scene, the panel and its charts."""
