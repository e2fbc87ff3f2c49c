"""What an author writes: symbols, problems of every kind, drawings, files of points."""
