"""The thesis's figures and tables."""
