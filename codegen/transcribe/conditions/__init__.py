"""What each kind of condition, at ends, at inner times, at every time or over all, adds to the share of an interval."""
