"""What there is to run and to review, and who changes what runs."""
