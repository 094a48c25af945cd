"""A policy by name: one that ships with the project, or the user's own as `package.module:Class`."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from cosim.errors import UsageError, unknown
from cosim.policies import POLICIES
from cosim.ports import Manifest, Policy


def load_policy(name: str) -> Policy:
    """A new policy. Raises UsageError when the name means nothing or the class is no policy."""
    if ":" not in name:
        if name not in POLICIES:
            raise unknown("policy", name, [*POLICIES, "package.module:Class"])
        return POLICIES[name]()
    module_name, _, class_name = name.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise UsageError(
            f"policy '{name}': module '{module_name}' cannot be imported: {type(error).__name__}: {error}"
        ) from error
    if not hasattr(module, class_name):
        classes = sorted(k for k, v in vars(module).items() if isinstance(v, type) and v.__module__ == module.__name__)
        raise unknown(f"class in module '{module_name}'", class_name, classes)
    try:
        policy: Policy = getattr(module, class_name)()
    except Exception as error:
        raise UsageError(f"policy '{name}' cannot be made: {type(error).__name__}: {error}") from error
    if not isinstance(getattr(policy, "manifest", None), Manifest):
        raise UsageError(f"policy '{name}' has no attribute 'manifest' that is a cosim.ports.Manifest")
    for method in ("reset", "act"):
        if not callable(getattr(policy, method, None)):
            raise UsageError(f"policy '{name}' has no method '{method}'; see cosim.ports.Policy")
    return policy
