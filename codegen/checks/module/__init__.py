"""Evidence that the emitted module says what was derived."""
