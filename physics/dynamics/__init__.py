"""Robot dynamics in PyBullet."""
