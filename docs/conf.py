"""Sphinx configuration of the guides: Markdown by MyST, the Python API from its docstrings."""

project = "Nisus"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["examples"]
html_theme = "furo"
html_title = "Nisus"
html_favicon = "../app/web/page/icon.svg"
myst_heading_anchors = 3
myst_enable_extensions = ["deflist"]
autosummary_generate = True
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
