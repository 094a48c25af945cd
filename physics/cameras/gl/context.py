"""OpenGL context of this process: EGL without a window, on a GPU or on Mesa's llvmpipe."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import moderngl

from cosim.core.errors import EngineError

VERSION: Final = 430
"""Required version, OpenGL 4.3, for compute shaders and storage buffers."""
_REQUIRED: Final = ("GL_ARB_buffer_storage",)
"""Extensions for the readback; part of OpenGL 4.4."""
LAYERS: bool | None = None
"""Draw pictures as layers on any renderer, or on none; None: on graphics cards."""
_LAYER_EXTENSIONS: Final = ("GL_ARB_shader_viewport_layer_array", "GL_ARB_clear_texture")
_LAYER_LIMITS: Final = (
    ("GL_MAX_UNIFORM_BLOCK_SIZE", 65_536),
    ("GL_MAX_VERTEX_SHADER_STORAGE_BLOCKS", 1),
    ("GL_MAX_ARRAY_TEXTURE_LAYERS", 128),
)
"""Required limits of the driver, for blocks and layers of `shading.PICTURES_MAX` pictures."""
PACKAGES: Final = "libegl1 libgl1 libegl-mesa0 libgl1-mesa-dri"


@lru_cache(maxsize=1)
def context() -> moderngl.Context:
    """Return the process's single context, created on first use.

    Use it in a `with` block around GL calls.
    Raises EngineError with the system packages to install, or with missing extensions.
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
    if missing := [name for name in _REQUIRED if name not in made.extensions]:
        driver = f"{made.info['GL_RENDERER']} ({made.info['GL_VERSION']})"
        made.release()
        raise EngineError(
            f"the gl camera needs {', '.join(missing)}, which {driver} lacks: install a newer "
            "driver, or use --camera bullet"
        )
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

    This is slower on a software renderer.
    Raises EngineError where LAYERS is set, and the driver cannot draw layers.
    """
    if LAYERS is None:
        return is_card(context) and not missing_for_layers(context)
    if LAYERS and (missing := missing_for_layers(context)):
        raise EngineError(
            f"this graphics driver cannot draw pictures as layers: it lacks {', '.join(missing)}"
        )
    return LAYERS


@lru_cache(maxsize=1)
def missing_for_layers(context: moderngl.Context) -> list[str]:
    """Return the extensions and limits that drawing layers needs, and the driver lacks."""
    lacks = [name for name in _LAYER_EXTENSIONS if name not in context.extensions]
    info: dict[str, Any] = dict(context.info)
    return lacks + [
        f"{name} of {least} (it is {info.get(name, 0)})"
        for name, least in _LAYER_LIMITS
        if info.get(name, 0) < least
    ]


@lru_cache(maxsize=1)
def renderer() -> str:
    """Return the renderer's name for records.

    Pictures have the same bits on the same renderer only.
    """
    with context() as gl:
        info = gl.info
    return f"gl: {info['GL_RENDERER']}, {info['GL_VERSION']}"
