"""What a page says of the measurements, one file a kind of problem."""
