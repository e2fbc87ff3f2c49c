"""Initial value problems: one step of every kind, and step after step."""
