"""OpenGL context of this process: EGL without a window, on a GPU or on Mesa's llvmpipe."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import moderngl

from cosim.core.errors import EngineError

VERSION: Final = 430
"""Required version, OpenGL 4.3, for indirect draws with counts in a buffer."""
LAYERS: bool | None = None
"""Draw pictures as layers on any renderer, or on none; None: on graphics cards."""
_FOR_LAYERS: Final = ("GL_ARB_shader_viewport_layer_array", "GL_ARB_clear_texture")
PACKAGES: Final = "libegl1 libgl1 libegl-mesa0 libgl1-mesa-dri"


@lru_cache(maxsize=1)
def context() -> moderngl.Context:
    """Return the process's single context, created on first use.

    Use it in a `with` block around GL calls.
    Raises EngineError with the system packages to install.
    """
    try:
        options: dict[str, Any] = {"standalone": True, "require": VERSION, "backend": "egl"}
        made: Any = moderngl.create_context(**options)
    except Exception as error:
        raise EngineError(
            f"the gl camera needs OpenGL {VERSION // 100}.{VERSION // 10 % 10} through EGL, and "
            f"there is none here ({error}). Install it (Debian, Ubuntu: apt-get install "
            f"{PACKAGES}; with a GPU its driver's EGL library), or use --camera bullet."
        ) from error
    made.__exit__(
        None, None, None
    )  # no thread holds the context; each drawing acquires it temporarily
    held: moderngl.Context = made
    return held


@lru_cache(maxsize=1)
def available() -> bool:
    """Return whether the gl camera works on this machine."""
    try:
        context()
    except EngineError:
        return False
    return True


@lru_cache(maxsize=1)
def is_card(context: moderngl.Context) -> bool:
    """Return whether the context draws on a graphics card, not on the processor."""
    return not any(
        name in context.info["GL_RENDERER"] for name in ("llvmpipe", "softpipe", "swrast", "SWR")
    )


def draws_layers(context: moderngl.Context) -> bool:
    """Return whether pictures are drawn as layers of one texture where possible.

    A software renderer reads the values of a picture faster from a block of its own, picture by
    picture.
    """
    if LAYERS is not None:
        return LAYERS
    return is_card(context) and all(name in context.extensions for name in _FOR_LAYERS)


@lru_cache(maxsize=1)
def renderer() -> str:
    """Return the renderer's name for records.

    Pictures have the same bits on the same renderer only.
    """
    with context() as gl:
        info = gl.info
    return f"gl: {info['GL_RENDERER']}, {info['GL_VERSION']}"
