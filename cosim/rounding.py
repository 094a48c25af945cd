"""numpy is told to compute without AVX-512, so that machines with and without it round alike.

Where a processor has AVX-512 numpy takes other sines, exponentials and sums for arrays, which
differ in the last bit. numpy reads what it shall leave out when it is loaded, from the environment:
so this comes first of all that `cosim` and its rooms import, imports nothing that loads numpy, and
what it sets goes on to every process that is started from here.
"""

from __future__ import annotations

import os
import sys
import warnings

_VARIABLE = "NPY_DISABLE_CPU_FEATURES"
_LEFT_OUT = ("X86_V4", "AVX512_ICL", "AVX512_SPR")
"""All that numpy has of AVX-512, by its own names. One that it or the processor lacks it passes
over."""


def settle_rounding() -> None:
    """Set the environment; warn where numpy is in this process already, and with AVX-512."""
    given = os.environ.get(_VARIABLE, "").replace(",", " ").split()
    os.environ[_VARIABLE] = " ".join(dict.fromkeys((*given, *_LEFT_OUT)))
    numpy = sys.modules.get("numpy")
    features = getattr(
        getattr(getattr(numpy, "_core", None), "_multiarray_umath", None), "__cpu_features__", {}
    )
    if any(features.get(name) for name in _LEFT_OUT):
        warnings.warn(
            "numpy was loaded before cosim, and computes with AVX-512: what this process "
            "simulates has other bits "
            "than on other machines and than what is shipped. Import cosim first, or set "
            f'{_VARIABLE}="{" ".join(_LEFT_OUT)}"',
            RuntimeWarning,
            stacklevel=3,
        )
