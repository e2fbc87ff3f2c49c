"""The stages from a request to a result: building, loading and solving."""
