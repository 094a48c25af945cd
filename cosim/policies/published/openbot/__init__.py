"""OpenBot's driving network: its manifest, and its graph made of the file that its authors
publish."""
