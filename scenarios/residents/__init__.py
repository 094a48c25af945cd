"""Residents: people of ours who are no events, on a behaviour graph of waypoints and things to do."""
