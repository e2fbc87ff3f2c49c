"""Model predictive control: a problem that is solved again at every sampling time, and the closed loop with a plant."""
