"""The robot's dynamics in PyBullet."""
