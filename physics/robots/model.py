"""Tables of robots with legs, and the URDF that is written from them."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

from cosim.spec.robot import Legs, Robot

Triple = tuple[float, float, float]

_ZERO: Triple = (0.0, 0.0, 0.0)


class Solid(NamedTuple):
    """Simple shape of a link.

    size_m: length, width, height of a box; diameter and length of a cylinder along z; diameter of a
        sphere.
    at_m, rpy_rad: centre and attitude in the link's frame.
    colour: material's name, "" for an invisible solid.
    touches: whether it collides.
    """

    shape: Literal["box", "cylinder", "sphere"]
    size_m: tuple[float, ...]
    at_m: Triple = _ZERO
    rpy_rad: Triple = _ZERO
    colour: str = ""
    touches: bool = False


class Link(NamedTuple):
    """Rigid body of a robot.

    middle_m: centre of mass in the link's frame.
    inertia_kgm2: about the axes of the link's frame through `middle_m`, without the rotor.
    """

    name: str
    mass_kg: float
    middle_m: Triple
    inertia_kgm2: Triple
    solids: tuple[Solid, ...] = ()


class Joint(NamedTuple):
    """Joint that carries the link `child`.

    at_m, rpy_rad: child's frame in the parent's frame at angle 0.
    axis: 0, 1 or 2 for x, y or z of the child's frame; None for a fixed joint.
    range_rad: smallest and largest angle.
    rotor_kgm2: inertia of the motor's rotor at the joint, after the gear.
    """

    name: str
    parent: str
    child: str
    at_m: Triple
    rpy_rad: Triple = _ZERO
    axis: int | None = None
    range_rad: tuple[float, float] = (0.0, 0.0)
    torque_nm: float = 0.0
    speed_radps: float = 0.0
    rotor_kgm2: float = 0.0


COLOURS: Final = {
    "body": (0.86, 0.87, 0.89),
    "lid": (0.10, 0.42, 0.62),
    "dark": (0.16, 0.16, 0.18),
    "rubber": (0.05, 0.05, 0.05),
}
"""Red, green and blue of the materials of all models."""


class Model(NamedTuple):
    """Robot as links and joints, in materials of `COLOURS`."""

    name: str
    remark: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]

    @property
    def mass_kg(self) -> float:
        """Mass of all links."""
        return sum(link.mass_kg for link in self.links)

    def inertia_kgm2(self, link: Link) -> Triple:
        """Return a link's inertia with its rotor, as written to the URDF.

        A URDF has no field for the inertia of rotors. It is added to the joint's axis, and half of
        it to the other two: Bullet sets an inertia to 0 that breaks the triangle inequality.
        """
        rotor, axis = 0.0, None
        for joint in self.joints:
            if joint.child == link.name:
                rotor, axis = joint.rotor_kgm2, joint.axis
        x, y, z = (
            round(own + (rotor if k == axis else 0.5 * rotor), 8)
            for k, own in enumerate(link.inertia_kgm2)
        )
        return x, y, z

    def urdf(self) -> str:
        """Return the text of the URDF."""
        lines = ['<?xml version="1.0"?>', f"<!-- {self.name}: {self.remark} -->"]
        lines.append(f'<robot name="{self.name}">')
        for name, colour in COLOURS.items():
            rgba = _numbers((*colour, 1.0))
            lines.append(f'  <material name="{name}"><color rgba="{rgba}"/></material>')
        for link in self.links:
            lines += ["", *self._link(link)]
            lines += [
                line for joint in self.joints if joint.child == link.name for line in _joint(joint)
            ]
        return "\n".join([*lines, "</robot>", ""])

    def _link(self, link: Link) -> list[str]:
        xx, yy, zz = self.inertia_kgm2(link)
        lines = [
            f'  <link name="{link.name}">',
            "    <inertial>",
            f'      <origin xyz="{_numbers(link.middle_m)}"/>',
            f'      <mass value="{link.mass_kg:g}"/>',
            f'      <inertia ixx="{xx:.8g}" iyy="{yy:.8g}" izz="{zz:.8g}" '
            'ixy="0" ixz="0" iyz="0"/>',
            "    </inertial>",
        ]
        for solid in link.solids:
            where = f'<origin xyz="{_numbers(solid.at_m)}" rpy="{_numbers(solid.rpy_rad)}"/>'
            form = f"{where}<geometry>{_geometry(solid)}</geometry>"
            if solid.colour:
                lines.append(f'    <visual>{form}<material name="{solid.colour}"/></visual>')
            if solid.touches:
                lines.append(f"    <collision>{form}</collision>")
        return [*lines, "  </link>"]


def torque_limits_nm(robot: Robot) -> dict[str, float]:
    """Return the torque limits of a robot with legs by joint."""
    assert isinstance(robot.drive, Legs)
    return dict(zip(robot.drive.joints, robot.drive.torque_nm, strict=True))


def box_inertia(mass_kg: float, size_m: Triple) -> Triple:
    """Return the inertia of a homogeneous box about its axes."""
    x, y, z = (mass_kg / 12.0 * side**2 for side in size_m)
    return y + z, x + z, x + y


def rod_inertia(mass_kg: float, diameter_m: float, length_m: float) -> Triple:
    """Return the inertia of a homogeneous cylinder along z about its axes."""
    aside = mass_kg * (0.75 * diameter_m**2 / 4.0 + 0.25 * length_m**2) / 3.0
    return aside, aside, mass_kg * diameter_m**2 / 8.0


def ball_inertia(mass_kg: float, diameter_m: float) -> Triple:
    """Return the inertia of a homogeneous sphere about its axes."""
    one = 0.1 * mass_kg * diameter_m**2
    return one, one, one


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _geometry(solid: Solid) -> str:
    if solid.shape == "box":
        return f'<box size="{_numbers(solid.size_m)}"/>'
    if solid.shape == "cylinder":
        diameter, length = solid.size_m
        return f'<cylinder radius="{0.5 * diameter:.9g}" length="{length:.9g}"/>'
    return f'<sphere radius="{0.5 * solid.size_m[0]:.9g}"/>'


def _joint(joint: Joint) -> list[str]:
    kind = "fixed" if joint.axis is None else "revolute"
    lines = [
        f'  <joint name="{joint.name}" type="{kind}">',
        f'    <parent link="{joint.parent}"/><child link="{joint.child}"/>',
        f'    <origin xyz="{_numbers(joint.at_m)}" rpy="{_numbers(joint.rpy_rad)}"/>',
    ]
    if joint.axis is not None:
        axis = " ".join("1" if k == joint.axis else "0" for k in range(3))
        low, high = joint.range_rad
        lines += [
            f'    <axis xyz="{axis}"/>',
            f'    <limit lower="{low:.9g}" upper="{high:.9g}" effort="{joint.torque_nm:g}" '
            f'velocity="{joint.speed_radps:g}"/>',
            '    <dynamics damping="0" friction="0"/>',
        ]
    return [*lines, "  </joint>"]
