"""Measurements of speed, memory and realism."""
