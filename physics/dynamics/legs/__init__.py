"""Gaits and joint control of legged robots."""
