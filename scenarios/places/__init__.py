"""Places of scenarios: nets, street maps and surfaces."""
