"""Under which heads `cosim --help` lists commands; those without one come first."""

from __future__ import annotations

LOOK, STEP_IN, MEASURE, PLACES = "Look at episodes", "Step into running episodes", "Measure", "Places"
LEARN = "Learn from demonstrations"
TRUST = "Trust what came out"
MANY = "Many machines"
