"""Build, load, solve: from a request to a result."""
