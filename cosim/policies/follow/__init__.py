"""`follow`: two networks detect people and walkable area; rules drive along its middle."""
