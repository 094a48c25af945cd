"""Runs of many episodes: local processes, Zenoh workers, Ray, policy hosts."""
