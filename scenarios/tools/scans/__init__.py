"""Tools for scans: training of Gaussian splats from photos."""
