"""Build and prove the frozen suites."""
