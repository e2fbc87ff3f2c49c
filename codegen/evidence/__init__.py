"""Evidence about a problem and its generated module: checks, analyses, reports and stress tests."""
