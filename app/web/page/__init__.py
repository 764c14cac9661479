"""The files that the page is made of."""
