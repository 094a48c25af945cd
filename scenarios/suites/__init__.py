"""Frozen suites, their builders, and scenarios written by users."""
