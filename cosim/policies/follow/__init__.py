"""`follow`: two networks see the street, a few rules drive: along the middle of the walkable
ground, round people."""
