"""Initial value problems: the steps of all schemes, and the motion step after step."""
