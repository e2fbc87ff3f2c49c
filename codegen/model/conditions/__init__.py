"""Kinds of conditions on a motion, one file each; `table.py` has a row for each of them."""
