"""One episode: its wiring, its judge, and what can be done with it."""
