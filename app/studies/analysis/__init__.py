"""What is computed of a running twin only while somebody looks: what if, and what is wrong."""
