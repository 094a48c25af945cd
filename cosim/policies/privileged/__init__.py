"""Policies that know the simulator's state: `orca` (the oracle), `route`, `social_force`."""
