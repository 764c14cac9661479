"""What a model is: its declaration, the checks when it loads, and the models made from it."""
