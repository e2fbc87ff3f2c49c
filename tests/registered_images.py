"""What tests of registration share that is no fixture."""

SHAPE = (120, 160)
"""Height and width of the images that tests register."""
