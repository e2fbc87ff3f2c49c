"""What is known about a problem without discretising it: exact and reference solutions, modified equations, orders."""
