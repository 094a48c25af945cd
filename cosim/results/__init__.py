"""Referee, metrics, records and run folders."""
