"""What all tests share: how long anything is waited for, and which examples are drawn."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

PATIENCE_S = 600.0
"""How long a test waits for what must happen: far beyond what a slow and busy machine needs. A test never waits for
it to be over, so that it costs nothing where all is well."""

settings.register_profile(
    "tests", deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
settings.load_profile("tests")
