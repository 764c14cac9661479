"""What leaves the page as a file: the track of a run as a table, and a report of it."""
