"""Collect demonstrations as data sets, and read them."""
