"""Scanned places: their ground, files and checks."""
