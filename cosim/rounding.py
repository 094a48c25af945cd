"""Make numpy compute without AVX-512, so that all machines round alike.

With AVX-512, numpy uses other implementations of sine, exponential and sum, which differ in the
last bit. numpy reads the excluded features from the environment when it is loaded. So every package
of the project imports this module first; it must not import numpy. Child processes inherit the
setting.
"""

from __future__ import annotations

import os
import sys
import warnings

_VARIABLE = "NPY_DISABLE_CPU_FEATURES"
_DISABLED_FEATURES = ("X86_V4", "AVX512_ICL", "AVX512_SPR")
"""numpy's names for its AVX-512 features. numpy ignores names that it or the processor lacks."""


def settle_rounding() -> None:
    """Set the environment variable; warn if numpy is already loaded and uses AVX-512."""
    given = os.environ.get(_VARIABLE, "").replace(",", " ").split()
    os.environ[_VARIABLE] = " ".join(dict.fromkeys((*given, *_DISABLED_FEATURES)))
    numpy = sys.modules.get("numpy")
    features = getattr(
        getattr(getattr(numpy, "_core", None), "_multiarray_umath", None), "__cpu_features__", {}
    )
    if any(features.get(name) for name in _DISABLED_FEATURES):
        warnings.warn(
            "numpy was loaded before cosim, and computes with AVX-512: what this process "
            "simulates has other bits "
            "than on other machines and than what is shipped. Import cosim first, or set "
            f'{_VARIABLE}="{" ".join(_DISABLED_FEATURES)}"',
            RuntimeWarning,
            stacklevel=3,
        )
