"""Ground meshes, materials, relief and tiles."""
