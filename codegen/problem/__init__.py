"""What an author writes: symbols, problems of every kind, drawings, files; reading problem files."""
