"""DroNet: its manifest, and its graph made of the weights that its authors publish."""
