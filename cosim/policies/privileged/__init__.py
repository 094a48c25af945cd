"""Policies that know the simulator's state: `orca` (the oracle), `orca-hasty`, `route`,
`social_force`."""
