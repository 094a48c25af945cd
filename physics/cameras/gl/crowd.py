"""People for the gl camera: skinned bodies, posed on the graphics card.

Per picture a few numbers per person go up: four baked frames with weights, place, heading, size. A first small pass
blends the frames and writes everybody's 24 joint matrices, in metres from the anchor, into a texture; the vertex
shaders of all passes skin with them. Bodies of all outfits and levels lie in one buffer; a pass is one indirect draw
for those near (four joints per vertex) and one for those far away (two).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import People
from physics.cameras.gl.shading import Pass
from physics.cameras.gl.skins import mesh_skins, tube_skins
from physics.cameras.view import Shot
from physics.people.body import COATS, body, far_body
from physics.people.clips import own_clips
from physics.people.figure import LEVELS, MESH_LEVELS
from physics.people.looks import ALL, look_of
from physics.people.poses import poses

LEVEL_PX: Final = (170.0, 56.0, 22.0)
"""Drawn height of a body, in pixels, below which the next coarser level is taken."""

_INSTANCE: Final = np.dtype([("person", "i4"), ("girth", "f4")])
_ROW: Final = 3 * 24
_CROWD_MIN: Final = 64

_NOBODY: Final[tuple[tuple[str, ...], bytes]] = ((), b"")

_POSE_VERTEX: Final = """#version 430
void main() { gl_Position = vec4(gl_VertexID == 2 ? 3.0 : -1.0, gl_VertexID == 1 ? 3.0 : -1.0, 0.0, 1.0); }
"""

_POSE_FRAGMENT: Final = """#version 430
layout(binding = 0) uniform sampler2D baked;
layout(binding = 1) uniform sampler2D told;
out vec4 row;
vec4 blended(int column, vec4 frames, vec4 weights) {
    vec4 sum = vec4(0.0);
    for (int k = 0; k < 4; k++)
        if (weights[k] > 0.0) sum += weights[k] * texelFetch(baked, ivec2(column, int(frames[k])), 0);
    return sum;
}
void main() {
    int column = int(gl_FragCoord.x), person = int(gl_FragCoord.y), axis = column % 3;
    vec4 frames = texelFetch(told, ivec2(0, person), 0), weights = texelFetch(told, ivec2(1, person), 0);
    vec4 place = texelFetch(told, ivec2(2, person), 0), turn = texelFetch(told, ivec2(3, person), 0);
    vec4 own = blended(column, frames, weights);
    if (axis < 2) {
        vec4 other = blended(column + (axis == 0 ? 1 : -1), frames, weights);
        own = turn.x * own + (axis == 0 ? -turn.y : turn.y) * other;
    }
    row = own * place.w;
    row.w += place[axis];
}
"""


class CrowdDrawing:
    """The people of a picture. shadows: whether they are shaded by shadow maps."""

    def __init__(self, context: moderngl.Context, shadows: bool) -> None:
        self._context = context
        self._clips = own_clips()
        matrices = self._clips.matrices
        self._baked = _texture(context, (_ROW, len(matrices)), 4, "f4", matrices.tobytes())
        self._pose = context.program(vertex_shader=_POSE_VERTEX, fragment_shader=_POSE_FRAGMENT)
        self._everywhere = context.vertex_array(self._pose, [])
        self._near = mesh_skins(context, lambda outfit, level: body(ALL[outfit], level), shadows)
        self._far = tube_skins(context, lambda outfit, level: far_body(ALL[outfit], level), shadows)
        self._held: list[moderngl.Buffer | moderngl.Texture | moderngl.Framebuffer] = []
        self._starts = np.zeros((LEVELS * len(ALL), 3), dtype=np.uint32)
        self._known = np.zeros(len(self._starts), dtype=bool)
        self._split = (0, 0, 0)
        self._room = 0
        self._dyed_for = _NOBODY
        self._grow(_CROWD_MIN)

    def set(
        self,
        people: People,
        time_s: float,
        z_m: Floats,
        shot: Shot,
        anchor: Floats,
        seen: NDArray[np.bool_],
        casts: NDArray[np.bool_],
    ) -> None:
        """Hold these people, standing at heights (N,) z_m, as this picture will show them; binds a framebuffer.

        seen: (N,) who can be in the picture; casts: (N,) whose shadow can.
        """
        count = len(people)
        self._split = (0, 0, 0)
        if not count:
            return
        if count > self._room:
            self._grow(2 * count)
        posed = poses(people, time_s, self._clips)
        told = np.zeros((count, 4, 4), dtype=np.float32)
        told[:, 0], told[:, 1] = posed.rows, posed.weights
        told[:, 2, :2], told[:, 2, 2], told[:, 2, 3] = people.xy - anchor, z_m, posed.scale
        told[:, 3, 0], told[:, 3, 1] = np.cos(people.heading), np.sin(people.heading)
        who = people.ids, people.age.tobytes()
        outfit, girth, colours = _dressed(*who)
        self._told.write(told, viewport=(0, 0, 4, count))
        if who != self._dyed_for:
            self._dyed.write(colours, viewport=(0, 0, len(COATS), count))
            self._dyed_for = who
        self._set_draws(outfit, levels(people.xy, z_m, shot), seen, casts, girth)
        self._posed.use()
        self._posed.viewport = (0, 0, _ROW, count)
        self._context.enable_only(moderngl.NOTHING)
        self._baked.use(0)
        self._told.use(1)
        self._everywhere.render(moderngl.TRIANGLES, vertices=3)

    def draw(self, stage: Pass) -> None:
        """Draw what was set; in the shadow maps of what moves everybody has few triangles."""
        near, far, shadow = self._split
        if stage == "still" or near + far + shadow == 0:
            return
        self._matrices.use(0)
        self._dyed.use(1)
        held = self._instances, self._commands
        if stage == "moving":
            self._far.draw(stage, *held, shadow, near + far)
        else:
            self._near.draw(stage, *held, near, 0)
            self._far.draw(stage, *held, far, near)

    def release(self) -> None:
        self._near.release()
        self._far.release()
        self._release_room()
        for thing in (self._baked, self._everywhere, self._pose):
            thing.release()

    def _set_draws(
        self,
        outfit: NDArray[np.intp],
        level: NDArray[np.intp],
        seen: NDArray[np.bool_],
        casts: NDArray[np.bool_],
        girth: NDArray[np.float32],
    ) -> None:
        """Fill the buffers of instances and of draws: near levels first, then far ones, then shadows, which have a
        level of their own behind the last."""
        cast = np.full(len(outfit), LEVELS)
        in_view, casting = seen.nonzero()[0], casts.nonzero()[0]
        people = np.concatenate([in_view, casting])
        if not len(people):
            return
        key = np.concatenate([level[in_view], cast[casting]]) * len(ALL) + outfit[people]
        order = key.argsort(kind="stable")
        people, key = people[order], key[order]
        begins = np.empty(len(key), dtype=bool)
        begins[0], begins[1:] = True, key[1:] != key[:-1]
        first = begins.nonzero()[0]
        form = key[first]
        start = self._start(form)
        commands = np.empty((len(first), 5), dtype=np.uint32)
        commands[:, 0], commands[:, 2:4], commands[:, 4] = start[:, 0], start[:, 1:], first
        commands[:-1, 1] = first[1:] - first[:-1]
        commands[-1, 1] = len(key) - first[-1]
        near, far = form.searchsorted((MESH_LEVELS * len(ALL), LEVELS * len(ALL))).tolist()
        self._split = near, far - near, len(form) - far
        table = np.empty(len(people), dtype=_INSTANCE)
        table["person"], table["girth"] = people, girth[people]
        self._instances.write(table)
        self._commands.write(commands)

    def _start(self, form: NDArray[np.intp]) -> NDArray[np.uint32]:
        """(F, 3) where bodies begin, by level * outfits + outfit; who casts a shadow has the coarsest level."""
        form = np.where(form < LEVELS * len(ALL), form, form - len(ALL))
        if not self._known[form].all():
            for one in dict.fromkeys(form[~self._known[form]].tolist()):
                level, outfit = divmod(one, len(ALL))
                self._starts[one] = (self._near if level < MESH_LEVELS else self._far).start(outfit, level)
                self._known[one] = True
        return self._starts[form]

    def _grow(self, room: int) -> None:
        """Make room for more people."""
        self._release_room()
        self._room, self._dyed_for = room, _NOBODY
        self._told = _texture(self._context, (4, room), 4, "f4")
        self._dyed = _texture(self._context, (len(COATS), room), 3, "f1")
        self._matrices = _texture(self._context, (_ROW, room), 4, "f4")
        self._posed = self._context.framebuffer([self._matrices])
        self._instances = self._context.buffer(reserve=2 * room * 8)
        self._commands = self._context.buffer(reserve=2 * room * 20)
        self._held = [self._posed, self._told, self._dyed, self._matrices, self._instances, self._commands]

    def _release_room(self) -> None:
        self._near.release()
        self._far.release()
        for thing in self._held:
            thing.release()
        self._held = []


@lru_cache(maxsize=64)
def _dressed(ids: tuple[str, ...], ages: bytes) -> tuple[NDArray[np.intp], NDArray[np.float32], bytes]:
    """(N,) outfits and girths of people, and their colours as they go up."""
    looks = list(map(look_of, ids, ages))
    girth = np.array([who.girth_m for who in looks], dtype=np.float32)
    return np.array([who.outfit for who in looks]), girth, np.stack([who.colours for who in looks]).tobytes()


def levels(xy: Floats, z_m: Floats, shot: Shot) -> NDArray[np.intp]:
    """(N,) level of detail of people at (N, 2) xy, standing at (N,) heights, by how tall they are in the picture."""
    eye = shot.eye_m
    far_m = np.sqrt((xy[:, 0] - eye[0]) ** 2 + (xy[:, 1] - eye[1]) ** 2 + (z_m + 0.9 - eye[2]) ** 2)
    tall_px = 1.75 / np.maximum(far_m, 0.1) * 0.5 * shot.size[1] / np.tan(0.5 * np.radians(shot.fov_deg))
    return np.asarray(np.searchsorted(-np.array(LEVEL_PX), -tall_px))


def _texture(
    context: moderngl.Context, size: tuple[int, int], channels: int, dtype: str, data: bytes | None = None
) -> moderngl.Texture:
    texture = context.texture(size, channels, data, dtype=dtype, alignment=1)
    texture.filter = moderngl.NEAREST, moderngl.NEAREST
    return texture
