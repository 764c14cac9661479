"""What the readings of a whole log say of each moment of it: a backward pass over what a fold did."""
