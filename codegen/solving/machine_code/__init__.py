"""Machine code of generated modules: compiled by several processes at once, and kept on the disk."""
