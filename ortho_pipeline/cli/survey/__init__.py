"""What a new user types first: the program alone, a folder to look at, and the file of a run."""
