"""Manifests of the paper's navigation networks and of a served one; see README.md."""
