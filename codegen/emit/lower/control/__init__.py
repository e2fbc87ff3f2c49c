"""Lowering of a control problem and its derivatives to strings; `module` combines the parts from the other files."""
