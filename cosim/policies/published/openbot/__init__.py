"""OpenBot's driving network: its manifest, and its graph generated from the published file."""
