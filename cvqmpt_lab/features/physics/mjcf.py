"""A robot and a scene as MJCF, MuJoCo's file format.

External planners read only the geometry. With `Physics` the file also has masses, motors, moving
fingers, doors as hinges, and the load. Each joint turns about or slides along the z-axis of its
body, as in `Robot.kinematics`. Every convex piece of a link and every obstacle is a body of its
own. Lengths are in metres.
"""

from collections.abc import Iterator, Mapping, Sequence
from enum import IntFlag
from itertools import combinations, product
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.collision.carried import carried_pairs, pairs_of_carried
from cvqmpt_lab.robot.dynamics import link_inertias
from cvqmpt_lab.robot.robot import Follower, Robot
from cvqmpt_lab.scene.cells import blocks_of
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Measured, Shape, Sphere

HAND_SITE = "hand"  # name of the site at the end effector
LOAD_BODY = "load"  # name of the carried body
# of every joint of the arm, as in MuJoCo Menagerie's Panda: [kg m^2], [Nm s/rad]
ARMATURE, DAMPING = 0.1, 1.0


class ContactBit(IntFlag):
    """Kinds of bodies in MuJoCo's contype and conaffinity."""

    FIXED = 1
    DOOR = 2
    ROBOT = 4
    LOAD = 8


class Body(NamedTuple):
    """A convex body that is fixed to a link."""

    name: str
    link: int  # index of the link; 0: the world
    T_link_body: np.ndarray  # (4, 4)
    shape: Shape


class Physics(NamedTuple):
    """Properties of a simulation beyond the geometry."""

    contact_time: float  # time constant of contacts, MuJoCo's solref [s]
    # sliding joints of the gripper, each with the joint that it follows, or None
    fingers: Mapping[str, Follower | None] = {}
    # more pairs of the robot's bodies that may touch than `unchecked_pairs`
    unchecked: tuple[tuple[str, str], ...] = ()
    doors: tuple[str, ...] = ()  # articulations of the scene that can move
    welded: tuple[Attachment, ...] = ()  # loads that are fixed to the hand
    free: SceneObject | None = None  # load that moves freely; it has a mass

    @property
    def step(self) -> float:
        """Time step [s]: 1 ms divided by an integer, about half of the contact time or less."""
        return 1e-3 / max(1, round(2e-3 / self.contact_time))


def bodies_of(
    robot: Robot, scene: Scene, carried: Sequence[Attachment] = (), measured: bool = False
) -> list[Body]:
    """Bodies of the robot's pieces in the order of `Robot.links`, of obstacles and of loads.

    Args:
        robot: the robot.
        scene: the scene with the obstacles.
        carried: the loads.
        measured: whether obstacles may be clouds and maps.

    Raises:
        InvalidInputError: an obstacle or a load is no convex solid.
    """
    found = [
        Body(f"piece_{k}", piece.link, piece.T_link_geometry, ConvexMesh(piece.vertices))
        for k, piece in enumerate(robot.links)
    ]
    items: list[SceneObject | Attachment] = [*scene.obstacles, *carried]
    for item in items:
        what = "load" if isinstance(item, Attachment) else "obstacle"
        if measured and what == "obstacle" and isinstance(item.shape, Measured):
            continue
        if not isinstance(item.shape, Box | Cylinder | Sphere | ConvexMesh):
            raise InvalidInputError(
                f"{what} {item.name!r} is of type {type(item.shape).__name__}: give boxes, "
                "cylinders, spheres or convex meshes"
            )
    found += [
        Body(f"obstacle_{k}", 0, obstacle.T_world_object, obstacle.shape)
        for k, obstacle in enumerate(scene.obstacles)
    ]
    for k, load in enumerate(carried):
        row, T_link_hand = robot.hand(load.end_effector)
        found.append(Body(f"{LOAD_BODY}_{k}", row, T_link_hand @ load.T_hand_object, load.shape))
    return found


def unchecked_pairs(robot: Robot, carried: Sequence[Attachment] = ()) -> Iterator[tuple[str, str]]:
    """Names of the pairs of robot pieces and loads that are not checked for collision."""
    pieces = [f"piece_{k}" for k in range(len(robot.links))]
    loads = [f"{LOAD_BODY}_{k}" for k in range(len(carried))]
    checked = {frozenset((pieces[i], pieces[k])) for i, k in robot.self_collision_pairs}
    checked |= {frozenset((pieces[i], loads[k])) for i, k in carried_pairs(robot, carried)}
    checked |= {frozenset((loads[k], loads[m])) for k, m in pairs_of_carried(robot, carried)}
    return (pair for pair in combinations(pieces + loads, 2) if frozenset(pair) not in checked)


def mjcf_of(robot: Robot, scene: Scene, physics: Physics | None = None) -> str:
    """MJCF text of robot and obstacles, and of the load if `physics` has one; the hand is a site.

    Args:
        robot: the robot.
        scene: the scene; its obstacles become bodies.
        physics: masses, motors, doors and load; None: only the geometry.
    """
    root = Element("mujoco", model="arm")
    SubElement(root, "compiler", angle="radian", autolimits="true", balanceinertia="true")
    assets = SubElement(root, "asset")
    world = SubElement(root, "worldbody")
    links, arm = [world], robot.kinematics
    bodies = link_inertias(robot) if physics else []
    followers = {joint.name: joint for joint in robot.followers}
    entries = zip(robot.moving_joints, arm.entry, strict=True)
    for j, (name, entry) in enumerate(entries):
        link = _placed(links[arm.parent[j]], f"link_{j + 1}", arm.rotation[j], arm.translation[j])
        kind = "slide" if arm.prismatic[j] else "hinge"
        joint = SubElement(link, "joint", name=name, type=kind, axis="0 0 1")
        if name not in followers:
            joint.set("range", numbers_text(np.r_[arm.lower[entry], arm.upper[entry]]))
        if physics is None:
            SubElement(link, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        else:
            _add_dynamics(joint, link, bodies[j], name in physics.fingers)
        links.append(link)
    carriers = _with_doors(world, scene, physics) if physics else {}
    door_of = {  # by name of an obstacle that moves with a door
        item: name
        for name in (physics.doors if physics else ())
        for item in scene.articulation(name).moves
    }
    pieces = len(robot.links)
    for k, body in enumerate(bodies_of(robot, scene, measured=physics is not None)):
        parent, T = links[body.link], body.T_link_body
        bit = ContactBit.ROBOT if k < pieces else ContactBit.FIXED
        door = door_of.get(scene.obstacles[k - pieces].name) if k >= pieces else None
        if door is not None:
            bit, parent = ContactBit.DOOR, carriers[door]
            T = np.linalg.inv(scene.articulation(door).T_world_joint) @ T
        part = _placed(parent, body.name, T[:3, :3], T[:3, 3])
        if isinstance(body.shape, Measured):
            for geom in _add_blocks(part, assets, body):
                _touching(geom, bit)
            continue
        geom = _add_shape(part, assets, body)
        if physics is not None:
            density = 600.0 if bit is ContactBit.DOOR else 0.0  # of wood [kg/m^3]
            _touching(geom, bit, density=density)
    row, T_link_hand = robot.hand()
    _placed(links[row], HAND_SITE, T_link_hand[:3, :3], T_link_hand[:3, 3], "site")
    contact = SubElement(root, "contact")
    hidden = [f"piece_{k}" for k, piece in enumerate(robot.links) if piece.self_only]
    standing = [f"obstacle_{k}" for k in range(len(scene.obstacles))]
    more = () if physics is None else physics.unchecked
    pairs = dict.fromkeys((*unchecked_pairs(robot), *more, *product(hidden, standing)))
    for first, second in pairs:
        SubElement(contact, "exclude", body1=first, body2=second)
    equality = SubElement(root, "equality") if followers else root
    for follower in followers.values():
        _couple(equality, follower)
    if physics is not None:
        for k, item in enumerate(physics.welded):
            row, T_link_hand = robot.hand(item.end_effector)
            name = f"{LOAD_BODY}_{k}" if k else LOAD_BODY
            held = Body(name, row, T_link_hand @ item.T_hand_object, item.shape)
            _add_load(links[row], assets, held, item.mass)
        if physics.free is not None:
            moving = Body(LOAD_BODY, 0, physics.free.T_world_object, physics.free.shape)
            part = _add_load(world, assets, moving, physics.free.mass)
            SubElement(part, "freejoint", name=LOAD_BODY)
        _add_motors(root, robot, physics)
    return tostring(root, encoding="unicode")


def _add_dynamics(
    joint: Element, link: Element, body: tuple[float, np.ndarray, np.ndarray], finger: bool
) -> None:
    """Add the rotor's inertia, damping and the link's mass.

    Fingers get a heavy rotor: without one, contacts push them aside by centimetres.

    body: mass [kg], centre of mass (3,) [m] and inertia (3, 3) [kg m^2].
    """
    rotor = (1.0, 250.0) if finger else (ARMATURE, DAMPING)
    joint.set("armature", repr(rotor[0]))
    joint.set("damping", repr(rotor[1]))
    if finger:
        joint.set("solreflimit", "0.004 1")
    mass, centre, tensor = body
    six = numbers_text(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    SubElement(link, "inertial", pos=numbers_text(centre), mass=repr(float(mass)), fullinertia=six)


def _with_doors(world: Element, scene: Scene, physics: Physics) -> dict[str, Element]:
    """Add a body with a joint for each door or drawer that moves, and return them by name.

    The value of the joint is 0 at the door's pose in the scene.
    """
    found = {}
    for name in physics.doors:
        door = scene.articulation(name)
        T = door.T_world_joint
        found[name] = _placed(world, f"door_{name}", T[:3, :3], T[:3, 3])
        SubElement(
            found[name],
            "joint",
            name=name,
            type="hinge" if door.kind == "hinge" else "slide",
            axis="0 0 1",
            range=numbers_text(np.array([door.lower, door.upper]) - door.value),
            # of a door [Nm s/rad], [Nm], [kg m^2]
            damping="0.5",
            frictionloss="0.3",
            armature="0.01",
        )
    return found


def _add_load(parent: Element, assets: Element, load: Body, mass: float | None) -> Element:
    """Add the body of a load of a mass [kg] in its parent; None: it has none."""
    T = load.T_link_body
    part = _placed(parent, load.name, T[:3, :3], T[:3, 3])
    _touching(_add_shape(part, assets, load), ContactBit.LOAD, mass=mass or 0.0)
    return part


def _touching(geom: Element, kind: ContactBit, **weight: float) -> None:
    """Set the kinds of bodies that a geom can touch, its friction, and its mass or density.

    Robot and load touch the robot, doors and fixed bodies; fixed bodies and doors do not touch each
    other.
    """
    rubber = "0.8 0.005 0.0001"  # sliding, torsional and rolling friction of pads
    moves = kind in (ContactBit.ROBOT, ContactBit.LOAD)
    touched = ContactBit.FIXED | ContactBit.DOOR | ContactBit.ROBOT if moves else ContactBit(0)
    values = {"contype": kind, "conaffinity": touched, "condim": 4, "friction": rubber}
    for name, value in {**values, **weight}.items():
        geom.set(name, str(value))


def _add_motors(root: Element, robot: Robot, physics: Physics) -> None:
    """Add the time step, motors of all joints, and the coupling of fingers that follow another."""
    option = SubElement(
        root, "option", timestep=repr(physics.step), integrator="implicitfast", cone="elliptic"
    )
    # friction stiffer than the normal force, so that held objects hardly creep
    option.set("impratio", "20")
    # links are excluded pair by pair; the filter would hide a load from the link before the last
    SubElement(option, "flag", multiccd="enable", filterparent="disable")
    usual = SubElement(SubElement(root, "default"), "geom")
    usual.set("solref", f"{physics.contact_time} 1")
    motors, equality = SubElement(root, "actuator"), SubElement(root, "equality")
    for name in robot.joint_names:
        SubElement(motors, "motor", name=name, joint=name)
    for follower in physics.fingers.values():
        if follower is not None:
            _couple(equality, follower)


def _couple(equality: Element, follower: Follower) -> None:
    """Couple a joint to the joint that it follows."""
    SubElement(
        equality,
        "joint",
        joint1=follower.name,
        joint2=follower.leader,
        polycoef=numbers_text(np.array([follower.offset, follower.multiplier, 0.0, 0.0, 0.0])),
        solref="0.004 1",
    )


def numbers_text(values: np.ndarray) -> str:
    """Text of numbers for an XML attribute, exact to the last bit."""
    return " ".join(repr(float(value)) for value in values)


def _placed(
    parent: Element,
    name: str,
    rotation: np.ndarray,
    translation: np.ndarray,
    tag: str = "body",
) -> Element:
    """Add an element with a name, a rotation (3, 3) and a translation (3,) [m]."""
    from scipy.spatial.transform import Rotation  # takes 0.3 s to import

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    quaternion = numbers_text(np.array([w, x, y, z]))
    return SubElement(parent, tag, name=name, pos=numbers_text(translation), quat=quaternion)


def _add_shape(part: Element, assets: Element, body: Body) -> Element:
    """Add a geom with the shape of a body."""
    name = f"{body.name}_geom"
    match body.shape:
        case Box():
            sizes = numbers_text(body.shape.half)
            return SubElement(part, "geom", name=name, type="box", size=sizes)
        case Cylinder():
            sizes = numbers_text(body.shape.half[1:])
            return SubElement(part, "geom", name=name, type="cylinder", size=sizes)
        case Sphere(radius):
            return SubElement(part, "geom", name=name, type="sphere", size=repr(radius))
        case ConvexMesh(vertices):
            SubElement(
                assets,
                "mesh",
                name=body.name,
                vertex=numbers_text(vertices.ravel()),
                inertia="convex",
            )
            return SubElement(part, "geom", name=name, type="mesh", mesh=body.name)
    raise InvalidInputError(
        f"{body.name} is of type {type(body.shape).__name__}: give a box, cylinder, sphere or "
        "convex mesh"
    )


def _add_blocks(part: Element, assets: Element, body: Body) -> Iterator[Element]:
    """Add a geom for each box of a map or cloud, in the order of `blocks_of`, and yield them.

    The padding of the boxes is the margin of their contacts: `Simulation` adds it to the depth. A
    box with padding is a mesh, because MuJoCo ignores margins between the edges of two boxes.
    """
    flat = 1e-4  # half of the least edge of a mesh [m]
    assert isinstance(body.shape, Measured)
    low, high, padding = blocks_of(body.shape, np.eye(4))
    meshes = dict[tuple[float, ...], str]()  # names of meshes by the half edges
    signs = np.array([*product((-1.0, 1.0), repeat=3)])
    for centre, half in zip(0.5 * (low + high), 0.5 * (high - low), strict=True):
        geom = SubElement(part, "geom", pos=numbers_text(centre))
        yield geom
        if not half.any():
            geom.set("type", "sphere")
            geom.set("size", repr(padding))
        elif padding == 0.0:
            geom.set("type", "box")
            geom.set("size", numbers_text(half))
        else:
            edges = tuple(np.maximum(half, flat).round(9).tolist())
            if edges not in meshes:
                meshes[edges] = f"{body.name}_block_{len(meshes)}"
                vertices = numbers_text((signs * edges).ravel())
                SubElement(assets, "mesh", name=meshes[edges], vertex=vertices, inertia="convex")
            geom.set("type", "mesh")
            geom.set("mesh", meshes[edges])
            geom.set("margin", repr(padding))
