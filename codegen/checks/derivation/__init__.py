"""Evidence that the derived equations are right."""
