"""Full-screen triangle of all passes over a whole picture: three vertices without attributes."""

from __future__ import annotations

from typing import Final

SPOT: Final = "vec2(gl_VertexID == 2 ? 3.0 : -1.0, gl_VertexID == 1 ? 3.0 : -1.0)"
"""GLSL of the position of a vertex in clip space, x and y."""
VERTEX: Final = f"""
out vec2 spot;
void main() {{
    spot = {SPOT};
    gl_Position = vec4(spot, 0.0, 1.0);
}}
"""
"""Vertex shader without a version line."""
