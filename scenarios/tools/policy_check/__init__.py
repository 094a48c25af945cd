"""Black-box checks of a policy for mistakes that its users easily overlook."""
