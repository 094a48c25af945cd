"""Networks as others published them: what their graphs want and answer, and the commands that make
these graphs."""
