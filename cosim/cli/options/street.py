"""Options that change a scenario's street: its robot, its people."""

from __future__ import annotations

ROBOT_HELP = "In place of the scenario's: which robot drives, by its name (`cosim list`)."
RESIDENTS_HELP = "In place of the scenario's: so many people who sit on benches, look into shop windows, wait at stops."

CROWD_HELP = "Street life in place of the suite's own: so many people, and vehicles; marked in every row."
VEHICLES_SHARE = 2 / 3
"""Vehicles that `--crowd` adds, for each person."""
GROUPS_HELP = "Share of the walkers, 0 to 1, who walk in groups of two and three."
ELDERLY_HELP = "Share of the walkers who are elderly: they walk slower."
CHILDREN_HELP = "Share of the walkers who are children, each in a group with an adult: at most half of --groups."
