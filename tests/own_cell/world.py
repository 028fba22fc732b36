"""The cell as a MuJoCo model: shelf, things on it, camera on a post, a Franka Panda, and layouts drawn by seed.

The arm has the maker's public Denavit-Hartenberg parameters and capsules for links; the world's frame is that of its
base, x into the shelf, y to the left, z up [m].
"""

import dataclasses
import math

import mujoco
import numpy as np

from .camera import PLACE as CAMERA
from .camera import target_pixels

FRONT, BACK, RIGHT, LEFT, BOARD, CEILING = 0.42, 0.78, -0.30, 0.40, 0.30, 0.70
THICK = 0.018
# Of physics [s].
STEP = 0.002
# Where the target's foot is to stand in the end: on a stand beside the shelf.
STAND = (0.32, -0.48, 0.20)
HOME = np.array([0.0301, -1.4702, 0.0279, -2.4376, 0.1466, 2.3087, 0.7012])
# a, alpha, d of each joint, and the flange.
DH = [
    (0.0, 0.0, 0.333),
    (0.0, -math.pi / 2, 0.0),
    (0.0, math.pi / 2, 0.316),
    (0.0825, math.pi / 2, 0.0),
    (-0.0825, -math.pi / 2, 0.384),
    (0.0, math.pi / 2, 0.0),
    (0.088, math.pi / 2, 0.0),
]
FLANGE = 0.107
# Of each link: mass [kg] and capsules as two ends and a radius, in the link's frame.
LINKS = [
    (4.5, [(0, 0, -0.19, 0, 0, -0.02, 0.06)]),
    (2.5, [(0, 0, -0.06, 0, 0, 0.06, 0.058), (0, 0, 0, 0, -0.15, 0, 0.058)]),
    (3.0, [(0, 0, -0.14, 0, 0, -0.05, 0.058), (0, 0, -0.05, 0.0825, 0, 0, 0.055)]),
    (3.0, [(0, 0, -0.055, 0, 0, 0.055, 0.056), (0, 0, 0, -0.0825, 0.1, 0, 0.055)]),
    (2.5, [(0, 0, -0.28, 0, 0, -0.22, 0.056), (0, 0.05, -0.2, 0, 0.06, -0.03, 0.038), (0, 0, -0.03, 0, 0, 0, 0.05)]),
    (1.6, [(0, 0, -0.04, 0, 0, 0.02, 0.05), (0, 0, 0, 0.088, 0, 0, 0.045)]),
    (0.8, [(0, 0, -0.02, 0, 0, 0.06, 0.044)]),
]
GAINS, DAMPING = [4500, 4500, 3500, 3500, 2000, 2000, 2000], [450, 450, 350, 350, 200, 200, 200]
EFFORT = [87, 87, 87, 87, 12, 12, 12]
FINGERTIP = 0.1034
# Outline of Franka's hand, as its public mesh has it to 3 mm: half depths and widths at heights above the flange [m].
# It is 63 mm deep at the flange, and 32 to 36 mm at the fingers.
PALM = [(0.0095, 0.09, -0.026), (0.0316, 0.03, 0), (0.0245, 0.099, 0), (0.018, 0.099, 0.055), (0.016, 0.093, 0.066)]
GREY = {"arm": "0.92 0.92 0.94", "shelf": "0.8 0.77 0.72"}


@dataclasses.dataclass(frozen=True)
class Thing:
    """Something on the shelf: full size [m] (of round things diameter twice, and height), mass, friction and colour."""

    name: str
    kind: str
    size: tuple[float, float, float]
    mass: float
    friction: float
    colour: tuple[float, float, float]

    @property
    def reach(self):
        """Radius of the circle around its foot [m]."""
        return math.hypot(*self.size[:2]) / 2 if self.kind == "box" else self.size[0] / 2


@dataclasses.dataclass(frozen=True)
class Layout:
    """Things with their places: x, y and yaw of each; the target comes first."""

    things: tuple[Thing, ...]
    places: tuple[tuple[float, float, float], ...]


def things_of(rng, target):
    """The target, two boxes, two cylinders and a mug, of drawn sizes, masses and frictions."""
    rough = lambda: round(float(rng.uniform(0.5, 0.8)), 3)  # noqa: E731
    scaled = lambda *size: tuple(round(float(s * rng.uniform(0.94, 1.06)), 4) for s in size)  # noqa: E731
    round_ = lambda r, h: (lambda d, z: (d, d, z))(*scaled(2 * r, h))  # noqa: E731
    sought = {
        "box": Thing("target", "box", (0.045, 0.035, 0.11), 0.15, rough(), (0.10, 0.62, 0.22)),
        "cylinder": Thing("target", "cylinder", (0.04, 0.04, 0.11), 0.15, rough(), (0.95, 0.95, 0.95)),
    }[target]
    return (
        sought,
        Thing("carton", "box", scaled(0.10, 0.062, 0.17), 0.35, rough(), (0.62, 0.45, 0.28)),
        Thing("box", "box", scaled(0.085, 0.07, 0.13), 0.30, rough(), (0.30, 0.36, 0.62)),
        Thing("can", "cylinder", round_(0.034, 0.16), 0.35, rough(), (0.75, 0.74, 0.70)),
        Thing("tin", "cylinder", round_(0.031, 0.11), 0.30, rough(), (0.55, 0.40, 0.55)),
        Thing("mug", "mug", round_(0.041, 0.097), 0.28, rough(), (0.88, 0.86, 0.80)),
    )


def drawn_layout(number, target="box"):
    """A layout in which the camera does not see the target; the same for the same number."""
    rng = np.random.default_rng([70, number])
    for _ in range(200):
        things = things_of(rng, target)
        world = World(Layout(things, tuple((0.0, 0.0, 0.0) for _ in things)))
        for _ in range(60):
            places = _drawn_places(rng, things)
            if places is None:
                continue
            world.put(places)
            if target_pixels(world, coarse=8) == 0 and target_pixels(world) == 0:
                return Layout(things, places)
    raise RuntimeError(f"layout {number} cannot be drawn")


def _drawn_places(rng, things):
    places = [(rng.uniform(FRONT + 0.13, BACK - 0.06), rng.uniform(RIGHT + 0.09, LEFT - 0.09))]
    # Something tall stands between it and the camera.
    towards = np.array(CAMERA[:2]) - places[0]
    blocker = int(rng.integers(1, 4))
    for i, thing in enumerate(things[1:], 1):
        for _ in range(40):
            if i == blocker:
                near = rng.uniform(0.01, 0.04) + thing.reach + things[0].reach
                x, y = places[0] + near * towards / np.hypot(*towards) + rng.normal(0, 0.006, 2)
            else:
                x, y = rng.uniform(FRONT, BACK), rng.uniform(RIGHT, LEFT)
            margin = thing.reach + 0.012
            inside = FRONT + margin < x < BACK - margin and RIGHT + margin < y < LEFT - margin
            apart = all(math.dist((x, y), p) > thing.reach + things[j].reach + 0.008 for j, p in enumerate(places))
            if inside and apart:
                places.append((x, y))
                break
        else:
            return None
    return tuple((float(x), float(y), float(rng.uniform(-math.pi, math.pi))) for x, y in places)


class World:
    """A layout in physics: `model` and `data`, who owns each geom, and how things are."""

    def __init__(self, layout):
        self.layout = layout
        self.model = mujoco.MjModel.from_xml_string(_xml(layout.things))
        self.data = mujoco.MjData(self.model)
        names = [self.model.body(b).name for b in self.model.geom_bodyid]
        self.owner = [_owner(name) for name in names]
        self.geom_owner = np.array(self.owner)
        self.things = [thing.name for thing in layout.things]
        self.things_body = [self.model.body(name).id for name in self.things]
        self.robot_geom = np.isin(self.geom_owner, ("arm", "hand", "left finger", "right finger"))
        self.data.qpos[:7] = HOME
        self.data.qpos[7:9] = 0.04
        self.put(layout.places)

    def put(self, places):
        """Stand the things at x, y and yaw."""
        for thing, (x, y, yaw) in zip(self.layout.things, places, strict=True):
            joint = self.model.joint(thing.name)
            address = int(joint.qposadr[0])
            self.data.qpos[address : address + 7] = (
                *(x, y, BOARD + thing.size[2] / 2 + 1e-4),
                *(math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)),
            )
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)

    @property
    def joints(self):
        """Measured joint angles [rad]."""
        return self.data.qpos[:7].copy()

    @property
    def width(self):
        """Measured distance between the fingers [m]."""
        return float(np.clip(self.data.qpos[7] + self.data.qpos[8], 0.0, 0.08))

    def poses(self):
        """Position and rotation matrix of each thing."""
        return {
            n: (self.data.xpos[b].copy(), self.data.xmat[b].reshape(3, 3).copy())
            for n, b in zip(self.things, self.things_body, strict=True)
        }

    def hand_pose(self):
        """`T_base_hand` (4, 4): the frame of Franka's hand, at the flange, turned by -45 degrees."""
        body, T = self.model.body("hand").id, np.eye(4)
        T[:3, :3], T[:3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        return T


def _owner(body):
    if body.startswith("link"):
        return "arm"
    return body.replace("_", " ")


def _numbers(*values):
    return " ".join(f"{v:.6g}" for v in values)


def _geom(kind, size, pos=(0, 0, 0), **more):
    given = " ".join(f'{k}="{v}"' for k, v in more.items())
    return f'<geom type="{kind}" size="{_numbers(*size)}" pos="{_numbers(*pos)}" {given}/>'


def _thing_xml(thing):
    x, y, z = thing.size
    look = {"rgba": _numbers(*thing.colour, 1), "class": "thing", "friction": _numbers(thing.friction, 0.003, 1e-4)}
    if thing.kind == "box":
        geoms = [_geom("box", (x / 2, y / 2, z / 2), mass=thing.mass, **look)]
    elif thing.kind == "cylinder":
        geoms = [_geom("cylinder", (x / 2, z / 2), mass=thing.mass, **look)]
    else:
        count, wall = 14, 0.0045
        middle = x / 2 - wall / 2
        half = (x / 2) * math.tan(math.pi / count)
        look["mass"] = thing.mass / (count + 2)
        geoms = [_geom("cylinder", (x / 2 - wall, 0.004), (0, 0, -z / 2 + 0.004), **look)]
        for turn in np.arange(count) * 2 * math.pi / count:
            place = (middle * math.cos(turn), middle * math.sin(turn), 0)
            geoms.append(_geom("box", (wall / 2, half, z / 2), place, euler=_numbers(0, 0, turn), **look))
        geoms.append(_geom("box", (0.012, 0.005, 0.027), (x / 2 + 0.010, 0, 0), **look))
    return f'<body name="{thing.name}"><freejoint name="{thing.name}"/>{"".join(geoms)}</body>'


def _palm():
    return [v for x, y, z in PALM for a in (x, -x) for b in (y, -y) for v in (a, b, z)]


def _arm_xml():
    text = ""
    for i, ((a, alpha, d), (mass, capsules)) in enumerate(zip(DH, LINKS, strict=True)):
        pos = (a, -math.sin(alpha) * d, math.cos(alpha) * d)
        text += f'<body name="link{i + 1}" pos="{_numbers(*pos)}" euler="{_numbers(alpha, 0, 0)}" gravcomp="1">'
        text += f'<joint name="joint{i + 1}" axis="0 0 1" class="arm"/>'
        for *ends, radius in capsules:
            text += f'<geom class="arm" type="capsule" fromto="{_numbers(*ends)}" size="{radius}" '
            text += f'mass="{mass / len(capsules):.4g}"/>'
    text += f'<body name="hand" pos="0 0 {FLANGE}" euler="{_numbers(0, 0, -math.pi / 4)}" gravcomp="1">'
    text += '<geom class="arm" type="mesh" mesh="palm" mass="0.7"/>'
    for side, name in ((1, "left_finger"), (-1, "right_finger")):
        turn = 0 if side == 1 else math.pi
        text += f'<body name="{name}" pos="0 0 0.0584" euler="{_numbers(0, 0, turn)}" gravcomp="1">'
        text += f'<joint name="{name}" type="slide" axis="0 1 0" range="0 0.04" damping="2" armature="0.1"/>'
        # A finger, and a pad whose face is where the fingers meet.
        text += _geom("box", (0.0105, 0.0085, 0.0185), (0, 0.0135, 0.0185), mass=0.03, **{"class": "arm"})
        text += _geom("box", (0.0088, 0.0045, 0.0087), (0, 0.0045, 0.0450), mass=0.01, **{"class": "pad"})
        text += "</body>"
    return text + "</body>" + "</body>" * 7


def _xml(things):
    board = (BACK + THICK - FRONT) / 2
    x, y, z = (FRONT + BACK + THICK) / 2, (LEFT + RIGHT) / 2, (BOARD + CEILING) / 2
    wide, high = (LEFT - RIGHT) / 2 + THICK, (CEILING - BOARD) / 2
    flat = {"class": "still", "rgba": GREY["shelf"] + " 1"}
    shelf = [
        _geom("box", (board, wide, THICK / 2), (x, y, BOARD - THICK / 2), **flat),
        _geom("box", (board, wide, THICK / 2), (x, y, CEILING + THICK / 2), **flat),
        _geom("box", (board, THICK / 2, high), (x, LEFT + THICK / 2, z), **flat),
        _geom("box", (board, THICK / 2, high), (x, RIGHT - THICK / 2, z), **flat),
        _geom("box", (THICK / 2, wide, high), (BACK + THICK / 2, y, z), **flat),
        _geom("box", (board - 0.02, wide - 0.02, (BOARD - THICK) / 2), (x + 0.02, y, (BOARD - THICK) / 2), **flat),
    ]
    # The camera's body and its post do not hide what it sees.
    own = {"class": "still", "rgba": "0.2 0.2 0.2 1", "group": "5"}
    behind = CAMERA[0] - 0.02
    camera = _geom("box", (0.0125, 0.045, 0.0125), (behind, CAMERA[1], CAMERA[2]), **own)
    post = _geom("cylinder", (0.015, (CAMERA[2] - 0.0125) / 2), (behind, CAMERA[1], (CAMERA[2] - 0.0125) / 2), **own)
    stand = _geom("box", (0.07, 0.07, STAND[2] / 2), (STAND[0], STAND[1], STAND[2] / 2), **flat)
    servos = "".join(
        f'<general joint="joint{i + 1}" gainprm="{k}" biastype="affine" biasprm="0 {-k} {-d}" forcerange="{-e} {e}"/>'
        for i, (k, d, e) in enumerate(zip(GAINS, DAMPING, EFFORT, strict=True))
    )
    return f"""<mujoco><compiler angle="radian" eulerseq="xyz"/>
    <option timestep="{STEP}" integrator="implicitfast" cone="elliptic" impratio="100"/>
    <default><geom solref="0.008 1" solimp="0.95 0.99 0.001"/>
      <default class="still"><geom contype="4" conaffinity="3" friction="0.3 0.003 0.0001" group="1"/></default>
      <default class="thing"><geom contype="2" conaffinity="3" condim="4" group="0"/></default>
      <default class="arm"><geom contype="1" conaffinity="0" friction="0.3 0.003 0.0001" group="2"
        rgba="{GREY["arm"]} 1"/><joint damping="1" armature="0.1"/></default>
      <default class="pad"><geom contype="1" conaffinity="0" friction="0.8 0.005 0.0001" group="2" condim="4"
        rgba="0.2 0.2 0.2 1"/></default></default>
    <asset><mesh name="palm" vertex="{_numbers(*_palm())}"/></asset>
    <worldbody>
      <body name="floor">{_geom("plane", (3, 3, 0.1), **{**flat, "rgba": "0.55 0.55 0.55 1"})}</body>
      <body name="wall">{_geom("box", (0.05, 3, 2), (1.6, 0, 1), **{**flat, "rgba": "0.7 0.72 0.75 1"})}</body>
      <body name="shelf">{"".join(shelf)}</body><body name="stand">{stand}</body>
      <body name="camera">{camera}</body><body name="post">{post}</body>
      <body name="link0">{_geom("capsule", (0.07, 0.05), (-0.03, 0, 0.07), **{"class": "arm"})}</body>
      {_arm_xml()}{"".join(_thing_xml(t) for t in things)}
    </worldbody>
    <equality><joint joint1="left_finger" joint2="right_finger" solref="0.004 1"/></equality>
    <actuator>{servos}<motor joint="left_finger"/><motor joint="right_finger"/></actuator></mujoco>"""
