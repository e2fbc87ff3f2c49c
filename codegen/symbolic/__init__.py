"""Tools for expressions, without mechanics: derivatives, tests for zero, common parts, tables, names."""
