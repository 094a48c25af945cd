"""DroNet: its manifest, and its graph generated from the published weights."""
