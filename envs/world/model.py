"""The MuJoCo model: a Panda in front of a shelf with eight object slots and the target (docs/method.md,
"The simulator").

One MJCF serves every scenario. Each slot is a free body with a geometry of every shape; unused geometries are shrunk
into the inside of the used one, and an unused slot is parked in front of the shelf as a weightless body of a
millimetre. Sizes, masses and inertias are set per world, on a copy of the compiled model.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.robot.arm_config import ARMS
from mechsearch_jax.robot.gripper import FINGER_BASE, RobotPart, finger_parts, hand_parts, link_parts
from mechsearch_jax.robot.kinematics import FINGER_TIPS, FLANGE, HAND_ANGLE, HOME, JOINTS
from mechsearch_jax.shapes import PRIMITIVES, Shape, by_shape, in_order, shape_of
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, inertial, solids
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.shelf import Shelf

# Keeps tall cylinders from rolling on their rim for ever [N m s, N s/m]; otherwise negligible.
BODY_DAMPING = 2e-3
# Friction of bodies against turning on the spot and against rolling [m]. Without the latter bottles that were pushed
# roll on, on their sides and on their rims, for many seconds.
BODY_TORSION, BODY_ROLLING = 5e-3, 3e-4
TINY = 1e-3
# Mass of an empty slot [kg], and its moments of inertia [kg m2].
EMPTY_MASS, EMPTY_INERTIA = 1e-3, 1e-6
# Torsional friction of an evenly pressed rubber pad of about 18 x 18 mm: two thirds of its mean radius [m].
FINGER_TORSION = 0.006
FINGER_FRICTION = 1.0

ARM_STIFFNESS = (18000.0, 18000.0, 14000.0, 14000.0, 8000.0, 8000.0, 8000.0)
ARM_VELOCITY_GAIN = (450.0, 450.0, 350.0, 350.0, 200.0, 200.0, 200.0)
ARM_DAMPING = 1.0
# One model serves all arms: what keeps an arm's own limits is who moves it.
LOWER, UPPER = np.min([arm.lower for arm in ARMS.values()], 0), np.max([arm.upper for arm in ARMS.values()], 0)
ARM_FORCE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
FINGER_STIFFNESS, FINGER_VELOCITY_GAIN, FINGER_FORCE = 1000.0, 40.0, 70.0
FINGER_TRAVEL = 0.04

# Geometries are smaller than the bodies by MARGIN, and contacts act at that distance from them: resting bodies touch at
# their true surfaces, yet collision detection always sees them a little apart.
MARGIN = 5e-4
OBJECT_BIT, ROBOT_BIT = 1, 2

# How much stiffer friction is than contact (`impratio`): at 10 what leans creeps at up to 5 mm/s, at 100 below 1 mm/s.
IMPEDANCE_RATIO = 100.0

# Mass [kg], centre of mass [m], and inertia about it (xx, yy, zz, xy, xz, yz) [kg m2] of links 1 to 7: C. Gaz et al.,
# "Dynamic identification of the Franka Emika Panda robot with retrieval of feasible parameters", RA-L 2019. The hand
# and fingers: the maker's data sheet.
LINK_INERTIAS = (
    (4.970684, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    (0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    (1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    (0.735522, (0.010517, -0.004252, 0.061597), (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
)
HAND_INERTIA = (0.73, (-0.01, 0.0, 0.03), (0.001, 0.0025, 0.0017, 0.0, 0.0, 0.0))
FINGER_INERTIA = (0.015, (0.0, 0.0, 0.0), (2.375e-6, 2.375e-6, 7.5e-7, 0.0, 0.0, 0.0))


def text(*numbers: float | np.floating) -> str:
    """Numbers as in MJCF."""
    return " ".join(f"{float(n):.9g}" for n in numbers)


def element(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    """A new element of MJCF; an underscore at the end of an attribute's name is left out."""
    return ElementTree.SubElement(parent, tag, {k.rstrip("_"): v for k, v in attributes.items()})


def add_bodies(
    root: ElementTree.Element, world: ElementTree.Element, compounds: Mapping[int, Compound], skin: float
) -> None:
    """Add the bodies of all slots, which are empty but for compounds.

    Args:
      root: of the MJCF, for meshes.
      world: the element of the world.
      compounds: by their slots.
      skin: how much smaller the geometry of compounds is than their solids [m].
    """
    for i in range(BODIES):
        body = element(world, "body", name=f"body{i}", pos=text(*parking_place(i)), gravcomp="1")
        element(body, "joint", name=f"body{i}", type="free", damping=text(BODY_DAMPING))
        element(body, "inertial", mass=text(EMPTY_MASS), pos="0 0 0", diaginertia=text(*[EMPTY_INERTIA] * 3))
        if i in compounds:
            add_compound(root, body, i, compounds[i], skin)
            continue
        for shape in in_order():
            name = geometry_name(shape, i)
            friction = text(shape.friction, BODY_TORSION, BODY_ROLLING)
            element(body, "geom", class_="object", name=name, type=shape.geometry, friction=friction)


def geometry_name(shape: Shape, slot: int) -> str:
    """The name of the geometry of a shape in a slot."""
    return f"{shape.name}{slot}"


def parking_place(slot: int) -> tuple[float, float, float]:
    """The position of an unused slot: far in front of the shelf, on the free side of all its infinite planes [m]."""
    return (-2.0, 0.02 * slot, 0.6)


def add_compound(
    root: ElementTree.Element, body: ElementTree.Element, slot: int, compound: Compound, skin: float
) -> None:
    """Add a compound's geometry to its body, with its principal axes; masses are set by `model.with_bodies`.

    Args:
      root: of the MJCF, for meshes.
      body: the element of the body, with the inertia of an empty slot.
      slot: of the body.
      compound: what it is made of.
      skin: how much smaller the geometry is than the solids [m].
    """
    axes = Rotation.from_matrix(inertial(compound).rotation).as_quat(scalar_first=True)
    weight = body.find("inertial")
    assert weight is not None
    weight.set("quat", text(*axes))
    for i, solid in enumerate(solids(compound.pieces)):
        attributes = {
            "class": "object",
            "name": f"solid{slot}_{i}",
            "pos": text(*solid.position),
            "quat": text(*solid.quaternion),
            "friction": text(compound.friction, BODY_TORSION, BODY_ROLLING),
        }
        attributes |= _mesh(root, attributes["name"], solid, skin) if solid.shape == CONVEX else _size(solid, skin)
        ElementTree.SubElement(body, "geom", attributes)


def _size(solid: Piece, skin: float) -> dict[str, str]:
    primitive = PRIMITIVES[solid.shape]
    half = np.array(solid.half_size) - skin
    return {"type": primitive.geometry, "size": text(*primitive.geometry_size(half, np))}


def _mesh(root: ElementTree.Element, name: str, solid: Piece, skin: float) -> dict[str, str]:
    assets = root.find("asset")
    if assets is None:
        assets = ElementTree.SubElement(root, "asset")
    vertices = drawn_in(np.array(solid.vertices), skin)
    ElementTree.SubElement(assets, "mesh", {"name": name, "vertex": text(*vertices.reshape(-1)), "inertia": "convex"})
    return {"type": "mesh", "mesh": name}


def drawn_in(vertices: Float[np.ndarray, "n 3"], skin: float) -> Float[np.ndarray, "n 3"]:
    """Vertices about their origin, shrunk so that the bounding box is smaller by about a skin on every side [m]."""
    extent = np.abs(vertices).max(axis=0)
    return vertices * np.maximum(1.0 - skin / extent, 0.5)


def _inertial(body: ElementTree.Element, inertia: tuple) -> None:
    mass, centre, full = inertia
    element(body, "inertial", mass=text(mass), pos=text(*centre), fullinertia=text(*full))


def _solids(body: ElementTree.Element, solids: Sequence[RobotPart]) -> None:
    for solid in solids:
        turn = Rotation.from_matrix(solid.T_frame_primitive[:3, :3]).as_quat(scalar_first=True)
        # A capsule is drawn in by its radius alone; a box on every side.
        drawn_in = (MARGIN, MARGIN, MARGIN) if solid.kind == "box" else (MARGIN, 0.0)
        element(
            body,
            "geom",
            class_="robot",
            type=solid.kind,
            size=text(*np.subtract(solid.size, drawn_in)),
            pos=text(*solid.T_frame_primitive[:3, 3]),
            quat=text(*turn),
        )


def _add_defaults(root: ElementTree.Element) -> None:
    default = element(root, "default")
    element(default, "geom", condim="4", margin=text(MARGIN))
    robot = element(default, "default", class_="robot")
    # The robot's contact parameters take priority, stiffer than the default: in a soft grip objects creep and turn.
    element(
        robot,
        "geom",
        contype=str(ROBOT_BIT),
        conaffinity=str(OBJECT_BIT),
        priority="1",
        friction=text(FINGER_FRICTION, FINGER_TORSION, 0.0),
        solref="0.01 1",
        group="3",
    )
    objects = element(default, "default", class_="object")
    size, bit = text(*[TINY] * 3), str(OBJECT_BIT)
    element(objects, "geom", condim="6", contype=bit, conaffinity=bit, size=size, group="0")
    # The friction of a contact is the larger of the two, here that of the body on the plane.
    planes = element(default, "default", class_="plane")
    element(planes, "geom", type="plane", contype="0", conaffinity=str(OBJECT_BIT), friction="0 0 0", group="4")
    boards = element(default, "default", class_="board")
    element(boards, "geom", type="box", contype="0", conaffinity=str(ROBOT_BIT), group="1", rgba="0.8 0.75 0.65 1")


def _add_shelf(world: ElementTree.Element, shelf: Shelf) -> None:
    for name, axis, value, normal in (
        ("board", 2, shelf.board, (0.0, 0.0, 1.0)),
        ("back", 0, shelf.back, (-1.0, 0.0, 0.0)),
        ("right", 1, shelf.right, (0.0, 1.0, 0.0)),
        ("left", 1, shelf.left, (0.0, -1.0, 0.0)),
    ):
        if name not in ("board", *shelf.faces):
            continue
        position = [0.0, 0.0, 0.0]
        position[axis] = value - MARGIN * sum(normal)
        element(
            world,
            "geom",
            class_="plane",
            name=f"{name}_plane",
            pos=text(*position),
            zaxis=text(*normal),
            size="1 1 1",
        )
    for name, (low, high) in shelf_boxes(shelf).items():
        centre, half = (high + low) / 2, (high - low) / 2
        # Carried objects may be above the upper board in front of the shelf, which therefore is a box, not a plane.
        meets = {"conaffinity": str(ROBOT_BIT | OBJECT_BIT)} if name == "ceiling" else {}
        element(world, "geom", class_="board", name=f"{name}_box", pos=text(*centre), size=text(*half), **meets)


def _add_robot(root: ElementTree.Element, world: ElementTree.Element) -> None:
    parent = world
    quarter = {0: (1.0, 0.0, 0.0, 0.0), 1: (0.5**0.5, 0.5**0.5, 0.0, 0.0), -1: (0.5**0.5, -(0.5**0.5), 0.0, 0.0)}
    actuator = element(root, "actuator")
    for i, (a, turns, d) in enumerate(JOINTS):
        position = (a, -turns * d, 0.0) if turns else (a, 0.0, d)
        parent = element(
            parent, "body", name=f"link{i + 1}", pos=text(*position), quat=text(*quarter[turns]), gravcomp="1"
        )
        _inertial(parent, LINK_INERTIAS[i])
        element(
            parent,
            "joint",
            name=f"joint{i + 1}",
            axis="0 0 1",
            range=text(LOWER[i], UPPER[i]),
            damping=text(ARM_DAMPING),
            armature="0.1",
        )
        _solids(parent, link_parts()[i])
        element(
            actuator,
            "position",
            name=f"joint{i + 1}",
            joint=f"joint{i + 1}",
            kp=text(ARM_STIFFNESS[i]),
            kv=text(ARM_VELOCITY_GAIN[i]),
            forcerange=text(-ARM_FORCE[i], ARM_FORCE[i]),
        )
    turned = (np.cos(HAND_ANGLE / 2), 0.0, 0.0, np.sin(HAND_ANGLE / 2))
    hand = element(parent, "body", name="hand", pos=text(0.0, 0.0, FLANGE), quat=text(*turned), gravcomp="1")
    _inertial(hand, HAND_INERTIA)
    _solids(hand, hand_parts())
    element(hand, "site", name="gripper", pos=text(0.0, 0.0, FINGER_TIPS), group="5")
    for name, quaternion in (("left", (1.0, 0.0, 0.0, 0.0)), ("right", (0.0, 0.0, 0.0, 1.0))):
        finger = element(
            hand, "body", name=f"{name}_finger", pos=text(0.0, 0.0, FINGER_BASE), quat=text(*quaternion), gravcomp="1"
        )
        _inertial(finger, FINGER_INERTIA)
        element(
            finger,
            "joint",
            name=f"{name}_finger",
            type="slide",
            axis="0 1 0",
            range=text(0.0, FINGER_TRAVEL),
            armature="0.1",
        )
        _solids(finger, finger_parts())
        element(
            actuator,
            "position",
            name=f"{name}_finger",
            joint=f"{name}_finger",
            kp=text(FINGER_STIFFNESS),
            kv=text(FINGER_VELOCITY_GAIN),
            forcerange=text(-FINGER_FORCE, FINGER_FORCE),
        )
    equality = element(root, "equality")
    element(equality, "joint", joint1="right_finger", joint2="left_finger", polycoef="0 1 0 0 0")


def shelf_corners(shelf: Shelf) -> dict[str, tuple[tuple[Any, Any, Any], tuple[Any, Any, Any]]]:
    """Lower and upper corners of the shelf's boards, axis-aligned boxes in the world [m], also of faces that it does
    not have; the shelf may be traced."""
    t = shelf.thickness
    low, high = (shelf.front, shelf.right - t), (shelf.back + t, shelf.left + t)
    return {
        "board": ((*low, shelf.board - t), (*high, shelf.board)),
        "ceiling": ((*low, shelf.ceiling), (*high, shelf.ceiling + t)),
        "back": ((shelf.back, low[1], shelf.board), (*high, shelf.ceiling)),
        "right": ((*low, shelf.board), (shelf.back, shelf.right, shelf.ceiling)),
        "left": ((shelf.front, shelf.left, shelf.board), (shelf.back, high[1], shelf.ceiling)),
    }


def shelf_boxes(shelf: Shelf) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """`shelf_corners` of the board and the faces that there are, as NumPy arrays."""
    there = ("board", *shelf.faces)
    return {name: (np.array(a), np.array(b)) for name, (a, b) in shelf_corners(shelf).items() if name in there}


def panda_shelf_mjcf(
    shelf: Shelf,
    camera: Camera,
    timestep: float = 0.004,
    compounds: Mapping[int, Compound] = MappingProxyType({}),
    skin: float = MARGIN,
) -> str:
    """The MJCF of the robot, the shelf, the camera, eight empty object slots and an empty slot for the target.

    Args:
      shelf: the shelf's dimensions.
      camera: the camera, for renderers; it must have square pixels and its principal point in the middle.
      timestep: of the simulation [s].
      compounds: the compounds in slots, whose geometry is in the model; all other slots are empty.
      skin: see `with_bodies`.
    """
    root = ElementTree.Element("mujoco", model="panda-shelf")
    element(root, "compiler", angle="radian", autolimits="true")
    option = element(
        root,
        "option",
        timestep=text(timestep),
        integrator="implicitfast",
        cone="elliptic",
        impratio=text(IMPEDANCE_RATIO),
        iterations="100",
        ls_iterations="50",
    )
    # Bounding volumes inside a body are not updated when its sizes are set per world.
    element(option, "flag", midphase="disable")
    element(element(root, "visual"), "map", znear="0.01")
    _add_defaults(root)
    world = element(root, "worldbody")
    element(world, "light", pos="-0.5 0.1 2", dir="0.6 0 -1")
    right, down, _ = np.array(camera.rotation).T
    element(
        world,
        "camera",
        name="camera",
        pos=text(*camera.position),
        xyaxes=text(*right, *-down),
        fovy=text(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))),
    )
    _add_shelf(world, shelf)
    _add_robot(root, world)
    add_bodies(root, world, compounds, skin)
    return ElementTree.tostring(root, encoding="unicode")


def compile_model(
    shelf: Shelf,
    camera: Camera,
    timestep: float = 0.004,
    compounds: Mapping[int, Compound] = MappingProxyType({}),
    skin: float = MARGIN,
) -> mujoco.MjModel:
    """The compiled `panda_shelf_mjcf`.

    Stops MuJoCo in this process from writing MUJOCO_LOG.TXT into the working folder: outcomes report what goes wrong.
    """
    log = mujoco.MjLogConfig.get()
    log.logto_file = False
    mujoco.MjLogConfig.set(log)
    return mujoco.MjModel.from_xml_string(panda_shelf_mjcf(shelf, camera, timestep, compounds, skin))


def masses_and_inertias(
    kind: Int[Any, "*batch"], half_size: Float[Any, "*batch 3"], library: Any = np
) -> tuple[Float[Any, "*batch"], Float[Any, "*batch 3"]]:
    """Masses [kg] and principal moments of inertia [kg m2] of solid bodies, along their own axes.

    Args:
      kind: codes of their shapes.
      half_size: half-extents [m].
      library: NumPy or `jax.numpy`, whichever the arrays are of.
    """
    volume = by_shape(kind, lambda shape: shape.volume(half_size, library), library)
    mass = volume * by_shape(kind, lambda shape: shape.density, library)
    moments = by_shape(kind[..., None], lambda shape: shape.moments(half_size, library), library)
    return library.asarray(mass), mass[..., None] * moments


def compounds_in(bodies: Sequence[Body | None]) -> dict[int, Compound]:
    """The compounds among the bodies in the slots, by slot."""
    return {i: body.compound for i, body in enumerate(bodies) if body is not None and body.compound is not None}


def mass_and_inertia(body: Body) -> tuple[float, Float[np.ndarray, " 3"]]:
    """Mass [kg] and principal moments of inertia [kg m2] of a solid body; of a plain one along its own axes."""
    if body.compound is not None:
        weight = inertial(body.compound)
        return weight.mass, weight.moments
    mass, inertia = masses_and_inertias(np.array(shape_of(body.shape).code), np.array(body.half_size, float))
    return float(mass), inertia


def with_bodies(
    model: mujoco.MjModel,
    bodies: Sequence[Body | None],
    skin: float = MARGIN,
    mass: float | Float[np.ndarray, " 9"] = 1.0,
) -> mujoco.MjModel:
    """A copy of the model whose slots have the shapes and masses of `bodies`; poses belong to the state.

    Args:
      model: the compiled model, with the geometry of compounds in their slots.
      bodies: one for each slot, the target last; None leaves a slot empty.
      skin: how much smaller the contact geometry is than the bodies [m]; 0 for pictures.
      mass: factor on the bodies' masses and inertias, or one for each.
    """
    model = copy.copy(model)
    factors = np.broadcast_to(mass, len(bodies))
    for i, body in enumerate(bodies):
        index = model.body(f"body{i}").id
        body_mass, inertia = mass_and_inertia(body) if body else (EMPTY_MASS, np.full(3, EMPTY_INERTIA))
        model.body_mass[index], model.body_inertia[index] = factors[i] * body_mass, factors[i] * inertia
        model.body_gravcomp[index] = 0.0 if body else 1.0
        if body is not None and body.compound is not None:
            continue
        for shape in in_order():
            used = body is not None and body.shape == shape.name
            half = np.array(body.half_size) - skin if body is not None and used else np.full(3, TINY)
            geom = model.geom(geometry_name(shape, i)).id
            model.geom_size[geom] = shape.geometry_size(half, np)
            model.geom_rbound[geom] = shape.bounding_radius(half, np)
            model.geom_aabb[geom] = [0.0, 0.0, 0.0, *half]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def body_geometries(model: mujoco.MjModel, slots: Iterable[int] = range(BODIES)) -> Int[np.ndarray, "n shapes"]:
    """The numbers of the geometries in bodies' slots, one for each shape; there must be no compounds in them."""
    return np.array([[model.geom(geometry_name(shape, i)).id for shape in in_order()] for i in slots])


def geometry_slots(model: mujoco.MjModel) -> Int[np.ndarray, " geoms"]:
    """The slot of the body that each geometry belongs to; -1 for those of robot and shelf."""
    slot = np.full(model.nbody, -1)
    slot[[model.body(f"body{i}").id for i in range(BODIES)]] = np.arange(BODIES)
    return slot[model.geom_bodyid]


def base_pose(
    model: mujoco.MjModel, T_world_base: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
    """Position and quaternion of the robot's first link in the world if its base stands elsewhere."""
    link = model.body("link1").id
    position, quaternion = model.body_pos[link].copy(), model.body_quat[link].copy()
    if np.array_equal(T_world_base, np.eye(4)):
        return position, quaternion
    turn = Rotation.from_matrix(T_world_base[:3, :3])
    at_base = Rotation.from_quat(quaternion, scalar_first=True)
    return turn.apply(position) + T_world_base[:3, 3], (turn * at_base).as_quat(scalar_first=True)


def move_robot(model: mujoco.MjModel, T_world_base: Float[np.ndarray, "4 4"]) -> None:
    """Put the robot's base elsewhere in a model, which is changed; nothing changes if it is where it was."""
    link = model.body("link1").id
    model.body_pos[link], model.body_quat[link] = base_pose(model, T_world_base)


def initial_state(model: mujoco.MjModel, bodies: Sequence[Body | None]) -> mujoco.MjData:
    """The robot at home with closed fingers and the bodies at their poses, all at rest."""
    data = mujoco.MjData(model)
    for i, angle in enumerate(HOME):
        data.joint(f"joint{i + 1}").qpos[0] = angle
    for i, body in enumerate(bodies):
        pose = (*body.position, *body.quaternion) if body else (*parking_place(i), 1.0, 0.0, 0.0, 0.0)
        data.joint(f"body{i}").qpos[:] = pose
    mujoco.mj_forward(model, data)
    return data
