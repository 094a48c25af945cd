"""The page of `cosim report`: tables, plots, maps and a gallery of failures in one HTML file."""
