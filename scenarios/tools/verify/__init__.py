"""Verify an installation."""
