"""A control problem and its derivatives as strings: `module` calls the others."""
