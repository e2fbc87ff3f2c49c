"""Moving horizons: a problem that is solved anew at every sampling time, and the loop with a plant."""
