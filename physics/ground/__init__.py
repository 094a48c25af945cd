"""The ground: meshes, materials, relief and tiles."""
