"""Tables: CSV, Parquet, MATLAB and NumPy files."""
