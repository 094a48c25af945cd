"""Published networks: their manifests, and commands that generate their graphs."""
