"""Robots with legs: gaits, joint torques, and detection of falls."""
