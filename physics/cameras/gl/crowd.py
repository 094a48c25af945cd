"""People of the gl camera: skinned bodies of all pictures of a batch, posed on the graphics card.

Each batch uploads a few numbers per person: four baked frames with weights, place, heading, size.
A first small pass blends the frames into 25 joint matrices per person, stored in a texture.
They are in metres from the picture's anchor; the vertex shaders of all passes skin with them.
Bodies of all outfits and levels are in one buffer.
A pass of a part of the batch is one indirect draw for near people (four joints per vertex) and one
for far people (two).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import People, PersonKind
from physics.cameras.gl.cloth import map_texture
from physics.cameras.gl.contact import CORNERS, ContactShadows
from physics.cameras.gl.full_screen import VERTEX as FULL_SCREEN
from physics.cameras.gl.instances import runs_of
from physics.cameras.gl.shading import MAPS_UNIT, Pass
from physics.cameras.gl.shots import Shots
from physics.cameras.gl.skins import mesh_skins, tube_skins
from physics.cameras.view import PERSON_MARGIN_M
from physics.people.appearance import look_of
from physics.people.body import COATS, body, far_body
from physics.people.clips import own_clips
from physics.people.families import skeleton
from physics.people.figure import LEVELS, MESH_LEVELS
from physics.people.gestures import GESTURES, SEATED_BACK_M
from physics.people.lofted_mesh import ROWS
from physics.people.poses import bodies_of, loops_of, poses_of
from physics.people.wardrobe import ALL, Season

LEVEL_PX: Final = (200.0, 92.0, 54.0, 40.0, 24.0)
"""Drawn heights of a body, in pixels, below which the next coarser level is used."""
CAST_M: Final = 18.0
"""Maximum distance from the eye of people that cast shadows, metres."""
_CONTACT_M: Final = 25.0
"""Maximum distance from the eye of people whose feet darken the ground, metres."""

_INSTANCE: Final = np.dtype(
    [("person", "i4"), ("dress", "i4"), ("girth", "f4"), ("tall", "f4"), ("scene_id", "i4")]
)
"""person: row of the matrix texture; dress: row of the colour texture; tall: of the modelled man
relative to the family; scene_id: of the scene."""
_SIT: Final = list(GESTURES).index("sit")
_SEAT_AHEAD_M: Final = SEATED_BACK_M - 0.1
"""Shift of people in wheelchairs, so that their hips are nearly at their place, metres."""
_TALL: Final = np.array([1.75 / skeleton(outfit.family).height_m for outfit in ALL])
_Dress = tuple[tuple[str, ...], bytes, bytes, int, Season, bool]
_ROW: Final = 3 * len(ROWS)
_CROWD_MIN: Final = 64
_SHADOWS: Final = LEVELS * len(ALL)
_FEET: Final = _SHADOWS + len(ALL)
_KEYS: Final = _FEET + 1
"""Number of forms of a part: outfits by level, plus one level for shadows, and feet."""
_ENDS: Final = (0, MESH_LEVELS * len(ALL), _SHADOWS, _FEET, _KEYS)

_POSE_FRAGMENT: Final = """#version 430
layout(binding = 0) uniform sampler2D baked;
layout(binding = 1) uniform sampler2D pose_inputs;
out vec4 row;
vec4 blended(int column, vec4 frames, vec4 weights) {
    vec4 sum = vec4(0.0);
    for (int k = 0; k < 4; k++)
        if (weights[k] > 0.0) sum += weights[k] * texelFetch(baked, ivec2(column, int(frames[k])), 0);
    return sum;
}
void main() {
    int column = int(gl_FragCoord.x), person = int(gl_FragCoord.y), axis = column % 3;
    vec4 frames = texelFetch(pose_inputs, ivec2(0, person), 0), weights = texelFetch(pose_inputs, ivec2(1, person), 0);
    vec4 place = texelFetch(pose_inputs, ivec2(2, person), 0), turn = texelFetch(pose_inputs, ivec2(3, person), 0);
    vec4 own = blended(column, frames, weights);
    if (axis < 2) {
        vec4 other = blended(column + (axis == 0 ? 1 : -1), frames, weights);
        own = turn.x * own + (axis == 0 ? -turn.y : turn.y) * other;
    }
    row = own * place.w;
    row.w += place[axis];
}
"""


class PeopleSeen(NamedTuple):
    """People of a picture.

    heights: function of (N, 2) points that returns the ground height
    shadows: people cast shadows
    seed: of their clothes and colours
    season: of their clothes
    rain: most people hold umbrellas
    """

    people: People
    time_s: float
    heights: Callable[[Floats], Floats]
    shadows: bool
    seed: int = 0
    season: Season = "mild"
    rain: bool = False

    @property
    def dressed(self) -> _Dress:
        """Values that determine their appearance."""
        people = self.people
        crowd = (people.kind == PersonKind.CROWD.value).tobytes()
        return people.ids, people.age.tobytes(), crowd, self.seed, self.season, self.rain


class _Worn(NamedTuple):
    """Appearance of N people.

    outfit, girth: (N,)
    colours: (N, coats, 4), with patterns
    bodies: (N, 4), as for poses
    sits: (N,) in a wheelchair, also while moving
    """

    outfit: NDArray[np.intp]
    girth: NDArray[np.float32]
    colours: NDArray[np.uint8]
    bodies: Floats
    sits: NDArray[np.bool_]


class _Shown(NamedTuple):
    """N people in view, or whose shadows may be.

    rows: (N,) of all people
    whose: (N,) pictures
    xy: (N, 2) world metres
    far_m: (N,) distances from the eyes
    seen, casts: (N,) in view, casting shadows
    """

    rows: NDArray[np.intp]
    whose: NDArray[np.intp]
    xy: Floats
    far_m: Floats
    seen: NDArray[np.bool_]
    casts: NDArray[np.bool_]


class CrowdDrawing:
    """Drawing of the people of the pictures of a batch."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._clips = own_clips()
        still = np.broadcast_to(
            np.eye(3, 4, dtype=np.float32), (len(self._clips.matrices), 1, 3, 4)
        )
        matrices = np.concatenate([self._clips.matrices, still], axis=1)
        self._baked = _texture(context, (_ROW, len(matrices)), 4, "f4", matrices.tobytes())
        self._pose_program = context.program(
            vertex_shader="#version 430" + FULL_SCREEN, fragment_shader=_POSE_FRAGMENT
        )
        self._everywhere = context.vertex_array(self._pose_program, [])
        self._maps = map_texture(context)
        self._contact = ContactShadows(context)
        self._near = mesh_skins(context, lambda outfit, level: body(ALL[outfit], level))
        self._far = tube_skins(context, lambda outfit, level: far_body(ALL[outfit], level))
        self._held: list[moderngl.Buffer | moderngl.Texture | moderngl.Framebuffer] = []
        self._starts = np.zeros((_KEYS, 3), dtype=np.uint32)
        self._known = np.zeros(len(self._starts), dtype=bool)
        self._split: list[list[int]] = []
        self._room = 0
        self._dressed: list[_Dress] = []
        self._grow(_CROWD_MIN)

    def set(
        self,
        watched: Sequence[PeopleSeen],
        shots: Shots,
        parts: NDArray[np.intp] | None = None,
        scene_ids: NDArray[np.intp] | None = None,
    ) -> None:
        """Upload the people of all pictures, each on the ground.

        parts: part of the batch of each picture, in order; each its own by default
        scene_ids: of the scenes of the pictures

        Binds a framebuffer, and texture units 0 and 1 until all pictures are drawn.
        """
        parts = np.arange(len(watched)) if parts is None else parts
        scene_ids = np.zeros(len(watched), dtype=np.intp) if scene_ids is None else scene_ids
        self._split = [[0] * len(_ENDS)] * (int(parts[-1]) + 1)
        if (shown := _shown(watched, shots)) is None:
            return
        worn = self._dress([one.dressed for one in watched])
        rows, whose = shown.rows, shown.whose
        z_m = _heights(watched, whose, shown.xy)
        far_m = self._pose(watched, shots, shown, worn, z_m)
        outfit = worn.outfit[rows]
        table = np.empty(len(rows), dtype=_INSTANCE)
        table["person"], table["dress"] = np.arange(len(rows)), rows
        table["girth"], table["tall"] = worn.girth[rows], _TALL[outfit]
        table["scene_id"] = scene_ids[whose]
        level = levels(shots, whose, far_m, z_m)
        near = shown.seen & (far_m < _CONTACT_M)
        self._set_draws(parts[whose], outfit, level, (shown.seen, shown.casts, near), table)
        self._draw_poses(len(rows))

    def _pose(
        self,
        watched: Sequence[PeopleSeen],
        shots: Shots,
        shown: _Shown,
        worn: _Worn,
        z_m: Floats,
    ) -> Floats:
        """Upload frames, places and headings of people; return (N,) distances from the eyes.

        z_m: (N,) ground heights
        """
        rows, whose, xy, far_m = shown.rows, shown.whose, shown.xy, shown.far_m
        heading = _joined([one.people.heading for one in watched])[rows]
        strides = _joined([one.people.strides for one in watched])[rows]
        pace = _joined([one.people.pace for one in watched])[rows]
        loops = _joined([loops_of(one.people.doing) for one in watched])[rows]
        cos, sin = np.cos(heading), np.sin(heading)
        sits = worn.sits[rows]
        if sits.any():
            loops = np.where(sits, _SIT, loops)
            pace = np.where(sits, 0.0, pace)
            xy = xy + (sits * _SEAT_AHEAD_M)[:, None] * np.column_stack([cos, sin])
            far_m = shots.far_m(whose, xy)
        time_s = np.array([one.time_s for one in watched])[whose]
        posed = poses_of(worn.bodies[rows], pace, strides, loops, time_s, self._clips)
        inputs = np.zeros((len(rows), 4, 4), dtype=np.float32)
        inputs[:, 0], inputs[:, 1] = posed.rows, posed.weights
        inputs[:, 2, :2], inputs[:, 2, 2] = xy - shots.anchor[whose], z_m
        inputs[:, 2, 3] = posed.scale
        inputs[:, 3, 0], inputs[:, 3, 1] = cos, sin
        self._pose_inputs.write(inputs, viewport=(0, 0, 4, len(rows)))
        return far_m

    def _draw_poses(self, people: int) -> None:
        """Draw the joint matrices of people, and bind them and the colours."""
        self._posed.use()
        self._posed.viewport = (0, 0, _ROW, people)
        self._context.enable_only(moderngl.NOTHING)
        self._baked.use(0)
        self._pose_inputs.use(1)
        self._everywhere.render(moderngl.TRIANGLES, vertices=3)
        self._matrices.use(0)
        self._dyed.use(1)

    def _dress(self, who: list[_Dress]) -> _Worn:
        """Return the appearance of all people, and upload their colours if they changed.

        who: as `PeopleSeen.dressed`
        """
        if who != self._dressed:
            each = [_worn(*one) for one in who]
            self._worn = _Worn(*(np.concatenate(column) for column in zip(*each, strict=True)))
            count = len(self._worn.outfit)
            if count > self._room:
                self._grow(2 * count)
            self._dyed.write(self._worn.colours, viewport=(0, 0, len(COATS), count))
            self._dressed = who
        return self._worn

    def draw(self, stage: Pass, shadows: int, part: int = 0) -> None:
        """Draw the people of a part; shadow maps of moving objects use the coarsest level.

        shadows: people are shaded by shadow maps
        """
        near, far, cast, feet, _ = self._split[part]
        if stage == "still" or near == feet:
            return
        held = self._instances, self._commands
        self._maps.use(MAPS_UNIT)
        if stage == "moving":
            self._far.draw(stage, shadows, *held, feet - cast, cast)
        else:
            self._near.draw(stage, shadows, *held, far - near, near)
            self._far.draw(stage, shadows, *held, cast - far, far)

    def draw_contact(self, layers: int, part: int = 0) -> None:
        """Darken the ground under the feet of the people of a part, without labels."""
        *_, feet, end = self._split[part]
        if feet != end:
            self._contact.draw(self._instances, self._commands, feet, end - feet, layers)

    def release(self) -> None:
        self._release_room()
        for thing in (self._baked, self._maps, self._everywhere, self._pose_program):
            thing.release()

    def _set_draws(
        self,
        part: NDArray[np.intp],
        outfit: NDArray[np.intp],
        level: NDArray[np.intp],
        shown: tuple[NDArray[np.bool_], ...],
        table: NDArray[np.void],
    ) -> None:
        """Fill the buffers of instances and draws.

        The order is by part: near levels, far levels, then shadows and feet as additional last
        levels.
        shown: masks of the people in view, of those who cast shadows, and of those with visible
            feet
        table: rows of the people
        """
        in_view, casting, near = (mask.nonzero()[0] for mask in shown)
        people = np.concatenate([in_view, casting, near])
        form_ = part * _KEYS
        key = form_ + outfit
        body = key[in_view] + level[in_view] * len(ALL)
        order, form, commands = runs_of(
            np.concatenate([body, key[casting] + _SHADOWS, form_[near] + _FEET])
        )
        start = self._start(form % _KEYS)
        commands[:, 0], commands[:, 2:4] = start[:, 0], start[:, 1:]
        feet = form % _KEYS == _FEET
        commands[feet, 3] = commands[feet, 4]  # these draws have no indices
        ends = np.arange(len(self._split))[:, None] * _KEYS + np.array(_ENDS)
        self._split = form.searchsorted(ends).tolist()
        self._instances.write(table[people[order]])
        self._commands.write(commands)

    def _start(self, form: NDArray[np.intp]) -> NDArray[np.uint32]:
        """Return (F, 3) buffer offsets of bodies, indexed by level * outfits + outfit.

        Shadows use the coarsest level.
        """
        if not self._known[form].all():
            for one in dict.fromkeys(form[~self._known[form]].tolist()):
                level, outfit = divmod(one, len(ALL))
                if one == _FEET:
                    self._starts[one] = CORNERS, 0, 0
                elif level == LEVELS:
                    self._starts[one] = self._start(np.array([one - len(ALL)]))
                else:
                    self._starts[one] = (self._near if level < MESH_LEVELS else self._far).start(
                        outfit, level
                    )
                self._known[one] = True
        return self._starts[form]

    def _grow(self, room: int) -> None:
        """Enlarge the buffers for more people."""
        self._release_room()
        self._room = room
        self._pose_inputs = _texture(self._context, (4, room), 4, "f4")
        self._dyed = _texture(self._context, (len(COATS), room), 4, "f1")
        self._matrices = _texture(self._context, (_ROW, room), 4, "f4")
        self._posed = self._context.framebuffer([self._matrices])
        self._instances = self._context.buffer(reserve=3 * room * _INSTANCE.itemsize)
        self._commands = self._context.buffer(reserve=3 * room * 20)
        self._held = [
            self._posed,
            self._pose_inputs,
            self._dyed,
            self._matrices,
            self._instances,
            self._commands,
        ]

    def _release_room(self) -> None:
        self._near.release()
        self._far.release()
        self._contact.release()
        for thing in self._held:
            thing.release()
        self._held = []


def _joined(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate arrays of pictures."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _shown(watched: Sequence[PeopleSeen], shots: Shots) -> _Shown | None:
    """Return the people to be drawn in pictures or their shadow maps; None without any."""
    counts = [len(one.people) for one in watched]
    if not sum(counts):
        return None
    whose = np.repeat(np.arange(len(watched)), counts)
    xy = _joined([one.people.xy for one in watched])
    casting = np.array([CAST_M if one.shadows else 0.0 for one in watched])
    far_m = shots.far_m(whose, xy)
    seen = shots.sees(whose, xy, PERSON_MARGIN_M)
    casts = far_m < casting[whose]
    rows = (seen | casts).nonzero()[0]
    if not len(rows):
        return None
    return _Shown(rows, whose[rows], xy[rows], far_m[rows], seen[rows], casts[rows])


def _heights(watched: Sequence[PeopleSeen], whose: NDArray[np.intp], xy: Floats) -> Floats:
    """Return (N,) ground heights at (N, 2) points of these pictures, with one query per ground."""
    grounds = list(dict.fromkeys(one.heights for one in watched))
    if len(grounds) == 1:
        return grounds[0](xy)
    ground = np.array([grounds.index(one.heights) for one in watched])[whose]
    z_m = np.empty(len(xy))
    for i, heights in enumerate(grounds):
        here = ground == i
        z_m[here] = heights(xy[here])
    return z_m


@lru_cache(maxsize=256)
def _worn(
    ids: tuple[str, ...], ages: bytes, crowd: bytes, seed: int, season: Season, rain: bool
) -> _Worn:
    looks = [
        look_of(name, age, seed, season, rain, bool(one))
        for name, age, one in zip(ids, ages, crowd, strict=True)
    ]
    return _Worn(
        np.array([who.outfit for who in looks], dtype=np.intp),
        np.array([who.girth_m for who in looks], dtype=np.float32),
        np.array(
            [np.column_stack([who.colours, who.patterns]) for who in looks], dtype=np.uint8
        ).reshape(-1, len(COATS), 4),
        bodies_of(ids, ages),
        np.array([ALL[who.outfit].companion == "wheelchair" for who in looks], dtype=bool),
    )


def levels(shots: Shots, whose: NDArray[np.intp], far_m: Floats, z_m: Floats) -> NDArray[np.intp]:
    """Return (N,) levels of detail of people by their height in the pictures.

    far_m: (N,) horizontal distances from the eyes
    z_m: (N,) ground heights
    """
    return np.asarray(np.searchsorted(-np.array(LEVEL_PX), -shots.tall_px(whose, far_m, z_m)))


def _texture(
    context: moderngl.Context,
    size: tuple[int, int],
    channels: int,
    dtype: str,
    data: bytes | None = None,
) -> moderngl.Texture:
    texture = context.texture(size, channels, data, dtype=dtype, alignment=1)
    texture.filter = moderngl.NEAREST, moderngl.NEAREST
    return texture
