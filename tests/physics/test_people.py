"""People: skeleton, bodies, looks, gaits, poses, and strides."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from cosim.core.state import PERSON_RADIUS_M, Age, People
from cosim.people.gait import PACES_MPS, STRIDES_M, Strides, first_stride, stature_m, stride_m
from physics.people.appearance import Look, companion_of, family_of, look_of
from physics.people.body import COATS, SkinnedBody, body
from physics.people.captures import capture, read_capture
from physics.people.clips import own_clips
from physics.people.cloth_maps import cloth_maps
from physics.people.families import FAMILIES, skeleton
from physics.people.figure import MESH_LEVELS
from physics.people.gaits import CYCLE_FRAMES
from physics.people.gestures import SEAT_M, SEATED_BACK_M
from physics.people.parts import _quaternions
from physics.people.poses import poses
from physics.people.skeleton import INDEX, JOINTS, forward, rodrigues
from physics.people.wardrobe import ALL, CLOTHES, SEASONS, season_of
from tests.support.blend import skinned

ROOT = Path(__file__).parents[2]
FORMS = [(outfit, level) for outfit in range(len(ALL)) for level in range(MESH_LEVELS)]


def crowd(n: int, doing: str = "walk", pace: float = 1.4, strides: Floats | None = None) -> People:
    names = tuple(sorted(f"c{i}" for i in range(n)))
    return People.of(names, np.zeros((n, 2)), np.zeros(n), np.full(n, pace), (doing,) * n, strides)  # type: ignore[arg-type]


def posed(made: SkinnedBody, row: int) -> Floats:
    return skinned(made.vertices, made.joints, made.weights, own_clips().matrices[row])


def test_forward_kinematics_of_a_bent_elbow() -> None:
    """A left elbow bent by a right angle from the T puts the wrist straight ahead of it, and no
    other joint moves."""
    man = skeleton("man")
    turns = np.tile(np.eye(3), (1, 24, 1, 1))
    turns[0, INDEX["left_elbow"]] = rodrigues([0.0, 0.0, -0.5 * np.pi])
    _, at = forward(turns, man.rest_m[:1], man)
    elbow, wrist = man.rest_m[INDEX["left_elbow"]], man.rest_m[INDEX["left_wrist"]]
    dx, dy, dz = wrist - elbow
    assert at[0, INDEX["left_wrist"]] == pytest.approx(np.add(elbow, (dy, -dx, dz)))
    still = [k for k, name in enumerate(JOINTS) if name not in ("left_wrist", "left_hand")]
    assert at[0, still] == pytest.approx(man.rest_m[still])


@pytest.mark.parametrize(("outfit", "level"), FORMS)
def test_bodies_are_closed_and_weighted(outfit: int, level: int) -> None:
    """Every edge has two triangles in opposite directions, weights fall and sum to 1, and normals
    are unit vectors."""
    made = body(ALL[outfit], level)
    assert edges_match(made.triangles) == (True, True)
    assert made.weights.sum(axis=1) == pytest.approx(1.0, abs=1e-6)
    assert (np.diff(made.weights, axis=1) <= 1e-7).all() and (made.weights >= 0.0).all()
    assert np.linalg.norm(made.normals, axis=1) == pytest.approx(1.0, abs=1e-4)
    assert made.coat.max() < len(COATS) and np.isfinite(made.vertices).all()


def test_bodies_stand_on_the_ground_at_their_stature() -> None:
    """Soles are at 0 and the top of the head within 6 cm of the family's stature, without hair and
    cap."""
    for outfit in ALL:
        made = body(outfit, 0)
        skin = made.vertices[made.coat == COATS.index("skin")]
        assert abs(float(made.vertices[:, 2].min())) < 0.005
        assert float(skin[:, 2].max()) == pytest.approx(skeleton(outfit.family).height_m, abs=0.06)


def edges_match(triangles: np.ndarray) -> tuple[bool, bool]:  # type: ignore[type-arg]
    """Return whether each directed edge occurs once, and whether no edge is a border."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = set(map(tuple, edges.tolist()))
    return len(directed) == len(edges), all((b, a) in directed for a, b in directed)


def test_soles_touch_the_ground_in_stance() -> None:
    """In every frame of every walk and gesture, the lowest point of the body is within 2 cm of the
    ground."""
    clips = own_clips()
    for k, family in enumerate(FAMILIES):
        made = body(next(outfit for outfit in ALL if outfit.family == family), 1)
        walks = [
            first + np.arange(0, CYCLE_FRAMES, 4)
            for first, pace in zip(clips.gaits[k], PACES_MPS, strict=True)
            if pace < 2
        ]
        rows = np.concatenate(
            [*walks, *(first[k : k + 1] + 8 for first in clips.gestures.values())]
        )
        for row in rows.tolist():
            assert abs(posed(made, row)[:, 2].min()) < 0.02, (family, row)


@pytest.mark.parametrize("pace", [0.4, 0.8, 1.2, 1.4, 1.7, 1.9])
def test_feet_do_not_slide(pace: float) -> None:
    """While the ball of a foot is down it drifts by less than 1 cm per step, at baked paces and
    between."""
    people = People.of(("c1",), [[0.0, 0.0]], [0.0], [pace], ("walk",))
    clips = own_clips()
    length = float(stride_m(pace, stature_m("c1", Age.ADULT)))
    phases = np.linspace(0.14, 0.52, 39)
    ball = skeleton(family_of("c1", Age.ADULT)).rest_m[INDEX["left_foot"]]
    at = []
    for phase in phases:
        pose = poses(
            People.of(people.ids, people.xy, people.heading, people.speed, people.doing, [phase]),
            0.0,
            clips,
        )
        matrix = pose.matrices(clips)[0, INDEX["left_foot"]].astype(float) * pose.scale[0]
        at.append(matrix[:, :3] @ ball + matrix[:, 3] + (phase * length, 0.0, 0.0))
    drift = np.ptp(np.array(at), axis=0)
    print(
        f"pace {pace}: ball of the foot drifts {1000 * drift[0]:.1f} mm ahead, "
        f"{1000 * drift[2]:.1f} mm up"
    )
    assert drift[0] < 0.01 and drift[1] < 0.01 and drift[2] < 0.02


def test_the_stopping_hand_is_held_out() -> None:
    """The right hand is half a metre ahead of the shoulder, at least as high, with the palm ahead
    and fingers up."""
    clips = own_clips()
    for k, family in enumerate(FAMILIES):
        matrix = clips.matrices[clips.gestures["stop"][k]].astype(float)
        rest = skeleton(family).rest_m
        f = skeleton(family).height_m / 1.75
        made = body(next(outfit for outfit in ALL if outfit.family == family), 0)
        hand = made.vertices[(made.joints[:, 0] == INDEX["right_hand"]) & (made.coat == 0)]
        shown = hand @ matrix[INDEX["right_hand"], :, :3].T + matrix[INDEX["right_hand"], :, 3]
        assert (
            shown[:, 0].min() > 0.5 * f
            and shown[:, 2].min() > rest[INDEX["right_shoulder"], 2] - 0.06
        )
        assert np.ptp(shown[:, 2]) > 3.0 * np.ptp(shown[:, 0])
        assert shown[:, 1].max() < -0.15 * f


def test_sitting_people_have_hips_on_the_seat_and_feet_in_front() -> None:
    """In all families but children, thighs are level and feet are flat at the place."""
    clips = own_clips()
    for k, family in enumerate(FAMILIES):
        if family == "child":
            continue
        matrix = clips.matrices[clips.gestures["sit"][k]].astype(float)
        rest = skeleton(family).rest_m
        at = {n: matrix[INDEX[n], :, :3] @ rest[INDEX[n]] + matrix[INDEX[n], :, 3] for n in JOINTS}
        assert at["left_hip"][0] == pytest.approx(-SEATED_BACK_M, abs=0.03)
        assert 0.0 < at["left_hip"][2] - SEAT_M < 0.12
        assert (
            at["left_knee"][0] - at["left_hip"][0] > 0.3
            and abs(at["left_knee"][2] - at["left_hip"][2]) < 0.12
        )
        assert -PERSON_RADIUS_M < at["left_ankle"][0] < PERSON_RADIUS_M
        assert at["left_ankle"][2] == pytest.approx(rest[INDEX["left_ankle"], 2], abs=0.02)


def test_quaternions_equal_those_of_scipy() -> None:
    """Random rotations, half turns and no turn have the same bits, and no people give no rows."""
    exact = [np.eye(3), *(np.diag(signs) for signs in np.eye(3) * 2.0 - 1.0)]
    drawn = Rotation.random(2000, random_state=np.random.default_rng(0)).as_matrix()
    turns = np.concatenate([exact, drawn])
    x = turns[..., 0] / np.linalg.norm(turns[..., 0], axis=-1, keepdims=True)
    z = np.cross(x, turns[..., 1])
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    rigid = np.stack([x, np.cross(z, x), z], axis=-1)
    wanted = Rotation.from_matrix(rigid, assume_valid=True).as_quat()
    assert {*np.abs(wanted).argmax(axis=1).tolist()} == {0, 1, 2, 3}
    assert np.array_equal(_quaternions(turns), wanted)
    assert _quaternions(np.zeros((0, 13, 3, 3))).shape == (0, 13, 4)


def test_looks_depend_on_name_age_and_seed() -> None:
    """The same name looks the same in another process, and another seed gives other colours."""
    names = [(f"c{i}", i % 3) for i in range(60)]
    code = (
        f"from physics.people.appearance import look_of\n"
        f"for n in {names!r}: w = look_of(*n); print(w.outfit, w.colours.tolist())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.splitlines() == [
        f"{look_of(*n).outfit} {look_of(*n).colours.tolist()}" for n in names
    ]
    assert len({look_of(*n).outfit for n in names}) > 16
    assert len({look_of(*n).colours.tobytes() for n in names}) == 60
    assert (
        sum(look_of(*n, 7).colours.tobytes() != look_of(*n).colours.tobytes() for n in names) == 60
    )


def test_outfit_colours_patterns_and_girth_are_independent() -> None:
    """Over 4,000 names, every pair of outfit, colours, beard and girth passes a chi-squared test of
    independence."""
    looks = [look_of(f"p{i}", Age.ADULT, 3, crowd=False) for i in range(4000)]
    men = [one for one in looks if ALL[one.outfit].family == "man"]

    def classes(values: Sequence[object]) -> np.ndarray:
        return np.unique(np.array([str(one) for one in values]), return_inverse=True)[1]

    def darker(look: Look, coat: str) -> int:
        return int(look.colours[COATS.index(coat)].astype(int).sum())

    girth = np.argsort(np.argsort([one.girth_m for one in men])) * 8 // len(men)
    draws = {
        "outfit": classes([one.outfit for one in men]),
        "girth": girth,
        "beard": classes([one.patterns[COATS.index("skin")] for one in men]),
        **{
            coat: np.argsort(np.argsort([darker(one, coat) for one in men])) * 8 // len(men)
            for coat in ("shoes", "bag", "cap", "metal", "skin")
        },
    }
    for one, other in itertools.combinations(draws, 2):
        table = np.zeros((draws[one].max() + 1, draws[other].max() + 1))
        np.add.at(table, (draws[one], draws[other]), 1.0)
        expected = table.sum(axis=1, keepdims=True) * table.sum(axis=0) / table.sum()
        chi2 = float(((table - expected) ** 2 / expected).sum())
        free = (table.shape[0] - 1) * (table.shape[1] - 1)
        assert abs(chi2 - free) < 5.0 * np.sqrt(2.0 * free), (one, other)


def test_sixty_outfits_follow_the_season() -> None:
    """There are at least 60 different outfits, and in every season each age wears several of its
    own and no others."""
    assert len({(one.body, one.top, one.bottom, one.tops) for one in CLOTHES}) == len(CLOTHES) >= 60
    names = [f"c{i}" for i in range(400)]
    for season in SEASONS:
        allowed = {one.outfit for one in CLOTHES if season in one.seasons}
        for age in (Age.ADULT, Age.CHILD, Age.ELDERLY):
            worn = {ALL[look_of(name, age, 0, season).outfit] for name in names}
            plain = {outfit for outfit in worn if not outfit.companion}
            assert plain <= allowed and len(plain) >= (8 if age == Age.ADULT else 2)
    coats = [
        sum(o.legs == "coat" for o in map(ALL.__getitem__, rows))
        for rows in (
            [look_of(name, Age.ADULT, 0, season).outfit for name in names]
            for season in ("summer", "winter")
        )
    ]
    assert coats[0] < 0.15 * len(names) < coats[1]
    assert [season_of(day, 48.0) for day in (15, 105, 172)] == ["winter", "mild", "summer"]
    assert season_of(15, -35.0) == "summer"


def test_rain_opens_umbrellas() -> None:
    """In rain most people hold an umbrella, without rain none, and the others keep what they
    push."""
    names = [f"c{i}" for i in range(2000)]
    dry, wet = ([companion_of(name, 3, rain) for name in names] for rain in (False, True))
    assert "umbrella" not in dry and 0.5 < wet.count("umbrella") / len(names) < 0.8
    assert {"dog", "pram", "bicycle", "wheelchair"} < set(dry)
    assert {companion_of(name, 3, True, crowd=False) for name in names} == {"", "umbrella"}
    assert all(b in (a, "umbrella") and (b == a or not a) for a, b in zip(dry, wet, strict=True))


def test_cloth_shows_folds_at_a_distance() -> None:
    """Averaged over 4 cm, a pixel at 10 m, the brightness of all tops still varies."""
    maps = cloth_maps()
    rows = sorted({int(look_of(f"c{i}", 0).patterns[COATS.index("top")]) for i in range(200)})
    assert len(rows) > 6
    for row in rows:
        chest = maps[row, 110:168, 20:76, 1].astype(float)[:55, :55].reshape(11, 5, 11, 5)
        means = chest.mean(axis=(1, 3))
        assert means.std() > 0.08 * means.mean()


def test_statures_follow_the_age() -> None:
    """Each name is a child, an adult or an elder as requested, and adults are 1.4 to 2 m tall."""
    names = [f"c{i}" for i in range(1000)]
    children, grown, old = (
        [stature_m(name, age) for name in names] for age in (Age.CHILD, Age.ADULT, Age.ELDERLY)
    )
    assert {family_of(name, Age.CHILD) for name in names} == {"child"}
    assert {family_of(name, Age.ADULT) for name in names} == {"man", "woman"}
    assert {family_of(name, Age.ELDERLY) for name in names} == {"elder"}
    assert min(children) > 1.1 and max(children) < 1.5 and np.mean(old) < np.mean(grown)
    assert min(grown) > 1.40 and max(grown) < 2.0 and 1.66 < float(np.mean(grown)) < 1.74


def test_strides_of_returning_people_start_again() -> None:
    """After a tick without people, the next ones are new."""
    strides = Strides(0.05)
    one = ("c1",), np.zeros((1, 2)), np.ones(1), [Age.ADULT]
    first = strides.update(*one)
    strides.update(*one)
    strides.update((), np.zeros((0, 2)), np.zeros(0), [])
    assert strides.update(*one) == first


def test_strides_count_the_distance_walked() -> None:
    """Standing and jumping add no strides."""
    strides = Strides(0.05)
    start = first_stride("c1")
    for k in range(201):
        count, pace = strides.update(
            ("c1",), np.array([[0.05 * k, 0.0]]), np.array([1.0]), [Age.ADULT]
        )
    assert count[0] - start == pytest.approx(
        10.0 / float(stride_m(1.0, stature_m("c1", Age.ADULT))), rel=1e-6
    )
    assert pace[0] == 1.0
    still, pace = strides.update(("c1",), np.array([[10.0, 0.0]]), np.array([0.0]), [Age.ADULT])
    assert still[0] == count[0] and 0.0 < pace[0] < 1.0
    assert (
        strides.update(("c1",), np.array([[50.0, 0.0]]), np.array([0.0]), [Age.ADULT])[0][0]
        == count[0]
    )
    assert stride_m(1.4, 1.75) == pytest.approx(STRIDES_M[PACES_MPS.index(1.4)])


def test_broken_captures_are_named(tmp_path: Path) -> None:
    """An invalid capture is refused with its path, and the shipped ones are read."""
    bad = tmp_path / "walk.txt"
    bad.write_text('{"Frames": [[1, 2, 3]]}')
    with pytest.raises(EngineError, match=r"walk\.txt: not a motion capture: 'Frames' must be"):
        read_capture(bad)
    with pytest.raises(EngineError, match=r"none\.txt: not a motion capture"):
        read_capture(tmp_path / "none.txt")
    assert capture("walk").turns.shape[1:] == (24, 3, 3)
