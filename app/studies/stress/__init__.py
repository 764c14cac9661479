"""A twin put to the test: mistakes that are made on purpose, and how soon and how rightly it says so."""
