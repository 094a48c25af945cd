"""Scenarios written by users as TOML files."""
