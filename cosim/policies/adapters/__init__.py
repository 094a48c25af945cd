"""Manifests of the paper's navigation networks, and one that is served; README.md tells what is
known of them."""
