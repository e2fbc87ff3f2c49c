"""What is known about a problem and about its module: check, analyse, report, stress."""
