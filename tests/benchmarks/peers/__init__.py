"""Other people's optimal-control software, set up at its best on the problems of this project."""
