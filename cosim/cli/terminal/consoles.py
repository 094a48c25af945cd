"""What the command line writes to: results to stdout, everything else to stderr."""

from rich.console import Console

out = Console(emoji=False)
err = Console(stderr=True, emoji=False)
