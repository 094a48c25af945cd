"""Policies that follow a schedule and see nothing."""
