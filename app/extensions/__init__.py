"""Optional parts of Nisus, each in a folder of its own, which nothing outside imports."""
