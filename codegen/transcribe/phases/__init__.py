"""Several phases in one chain of intervals: common names, switches between them, guesses."""
