"""The derived equations, laid out for people to read."""
