"""A simulated robot cell with the interface of a real one: a camera takes images, an arm follows trajectories.

    cell = SimulatedCell(workcell, scenario)
    step = searcher.next(*cell.look(), joints=cell.joints, width=cell.width)
    searcher.acted(ok=cell.follow(step.trajectory).ok)

It replaces the real cell for a `Searcher`. Images come from MuJoCo's ray-casting of the simulated scene with the robot,
through a pinhole model of this module: the package's own camera is not involved. The whole trajectory is simulated,
including the motions through free space.

Approximations: an arm that is held up follows its trajectory to the end and reports it afterwards. The fingers follow
the trajectory's width and force at once, whatever becomes of a grasp. The grip force exceeds the trajectory's by the
fingers' stiffness times half of what the object is wider than it was recognised, or falls short of it. For objects the
shelf's faces are planes that go on in front of it, so that a target can only be put down between the side walls, at the
board's height or above.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import ARM, LAG, ROBOT
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import BODIES, TARGET, slots
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.robot_trajectory import RobotTrajectory
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario

# Colours of the objects' slots, the shelf, the robot and the background: only the target's has a strong hue.
OBJECT_COLOURS: tuple[tuple[float, float, float], ...] = (
    (0.55, 0.55, 0.58),
    (0.72, 0.62, 0.45),
    (0.35, 0.42, 0.60),
    (0.82, 0.80, 0.70),
    (0.45, 0.38, 0.33),
    (0.50, 0.62, 0.70),
    (0.66, 0.66, 0.40),
    (0.58, 0.48, 0.66),
)
SHELF_COLOUR = (0.80, 0.76, 0.70)
ROBOT_COLOUR = (0.93, 0.93, 0.95)
BACKGROUND_COLOUR = (0.85, 0.87, 0.90)
# Direction towards the light, and the share of light that reaches every surface.
LIGHT, AMBIENT = (-0.55, -0.35, 0.76), 0.5
# Owners of pixels beside the slots of bodies.
SHELF, ROBOT_LINK, NOTHING = BODIES, BODIES + 1, -1
# The model's groups of geometries that the camera sees: robot, boards and bodies, not the planes that contacts use.
SHOWN_GROUPS = np.array([1, 1, 0, 1, 0, 0], np.uint8)
# Rays end here [m].
FARTHEST = 10.0
# Largest distance of a joint from where a trajectory begins [rad].
START_TOLERANCE = 0.02
# Closed fingers that are farther apart than this hold something [m].
HOLDING = 0.004


@dataclasses.dataclass(frozen=True)
class SensorNoise:
    """Noise of the camera's images: normal, independent for every pixel.

    Attributes:
      depth: standard deviation of the depth [m].
      colour: standard deviation of every channel, in shares of full brightness.
      missing: share of the pixels without a measured depth.
    """

    depth: float = 0.001
    colour: float = 4 / 255
    missing: float = 0.005

    def __post_init__(self):
        if not (self.depth >= 0 and self.colour >= 0 and 0 <= self.missing < 1):
            raise InputError(f"SensorNoise: depth and colour must be at least 0, missing a share below 1, not {self}")


class Look(NamedTuple):
    """Images of the camera: the first arguments of `Searcher.next`.

    Attributes:
      depth: along the camera's z [m], shape (H, W); 0 where nothing was measured.
      colour: shape (H, W, 3).
    """

    depth: Float[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 3"]


class Followed(NamedTuple):
    """Result of a trajectory.

    Attributes:
      ok: success as a robot's controller would report it: no joint left its reference by more than the trajectory's
        bounds, and after a retrieval the closed fingers hold something.
      tracking_error: largest distance of a joint from its reference [rad].
      fallen: scenario indices of the objects that left the board, `TARGET` for the target; never an object in the hand.
      retrieved: whether the target is in the closed hand outside the shelf, and nothing has left the board since the
        cell was set up.
    """

    ok: bool
    tracking_error: float
    fallen: tuple[int, ...]
    retrieved: bool


class SimulatedCell:
    """A shelf with objects, a camera and an arm in MuJoCo.

    Attributes:
      workcell: camera, shelf and arm.
      noise: of the camera.
    """

    def __init__(
        self,
        workcell: Workcell,
        scenario: Scenario,
        *,
        noise: SensorNoise | None = None,
        target_colour: tuple[float, float, float] = (0.7282, 0.1558, 0.2099),
        seed: int = 0,
    ):
        """Set the scene up, with the arm at home and the fingers closed.

        Args:
          workcell: camera, shelf and arm.
          scenario: what stands on the shelf, in the robot's frame.
          noise: of the camera; the default if None.
          target_colour: red, green and blue in 0 to 1.
          seed: of the noise.

        Raises:
          InputError: there are more objects than slots.
        """
        self.workcell, self.noise = workcell, noise or SensorNoise()
        self._rng = np.random.default_rng(seed)
        self._colours = np.array([*OBJECT_COLOURS, target_colour, SHELF_COLOUR, ROBOT_COLOUR, BACKGROUND_COLOUR])
        self._bodies = slots(scenario)
        self._world = NativeWorld(workcell.shelf, workcell.camera)
        self._world.reset(scenario)
        self._world.drive(np.zeros((1, ROBOT)) + self._control(np.array(workcell.arm.home), 0.0), at_once=True)
        blank = models.compile_model(workcell.shelf, workcell.camera)
        # Full size for pictures; contact geometry is a little smaller.
        self._seen = models.with_bodies(blank, self._bodies, skin=0.0)
        self._owner = np.array([*(_owner(blank.geom(i).name) for i in range(blank.ngeom)), NOTHING])

    @property
    def joints(self) -> Float[np.ndarray, " 7"]:
        """Where the arm is [rad]."""
        return self._world.positions[:ARM].copy()

    @property
    def width(self) -> float:
        """How far the fingers are apart [m]."""
        return max(float(self._world.positions[ARM:ROBOT].sum()), 0.0)

    @property
    def fallen(self) -> Bool[np.ndarray, " 9"]:
        """Whether each body has left the board, the target last."""
        return self._world.fallen

    def scenario(self, name: str) -> Scenario:
        """The present scene."""
        return self._world.scenario(name)

    def look(self) -> Look:
        """Take a depth and a colour image, registered to each other."""
        depth, normal, owner = self.shown()
        light = np.array(LIGHT) / np.linalg.norm(LIGHT)
        shade = AMBIENT + (1.0 - AMBIENT) * np.maximum(normal @ light, 0.0)
        colour = self._colours[owner] * np.where(owner == NOTHING, 1.0, shade)[..., None]
        colour = colour + self._rng.normal(0.0, self.noise.colour, colour.shape)
        measured = np.isfinite(depth) & (self._rng.random(depth.shape) >= self.noise.missing)
        noisy = depth + self._rng.normal(0.0, self.noise.depth, depth.shape)
        return Look(
            np.where(measured, noisy, 0.0).astype(np.float32),
            np.round(255 * np.clip(colour, 0.0, 1.0)).astype(np.uint8),
        )

    def target_pixels(self) -> int:
        """Number of pixels of the target that the camera sees."""
        return int(np.sum(self.shown()[2] == TARGET))

    def follow(self, trajectory: RobotTrajectory) -> Followed:
        """Follow a trajectory from where the arm is to its end, and let everything come to rest.

        Raises:
          InputError: it does not begin where the arm is.
        """
        apart = float(np.abs(trajectory.position[0] - self.joints).max())
        if apart > START_TOLERANCE:
            raise InputError(f"trajectory: begins {apart:.3f} rad from where the arm is; plan from the present joints")
        timestep = float(trajectory.time[1] - trajectory.time[0])
        ahead = LAG * np.diff(trajectory.position, axis=0) / timestep
        rows = zip(trajectory.position[:-1] + ahead, trajectory.width[1:], trajectory.force[1:], strict=True)
        controls = np.array([self._control(position, width, force) for position, width, force in rows])
        # A target that is put down is judged in the hand.
        carried = len(controls) if trajectory.put_down is None else trajectory.put_down
        states = self._world.drive(controls[:carried])
        takes = trajectory.action == "retrieve"
        holds = self.width > HOLDING
        held, outside = self._world.holds_target if takes else (False, False)
        if carried < len(controls):
            states = np.concatenate([states, self._world.drive(controls[carried:])])
        error = float(np.abs(states[:, :ARM] - trajectory.position[1:]).max())
        fallen = self.fallen & ~(held & (np.arange(BODIES) == TARGET))
        return Followed(
            ok=error <= trajectory.bounds.tracking and (holds or not takes),
            tracking_error=error,
            fallen=tuple(np.flatnonzero(fallen).tolist()),
            retrieved=held and outside and not fallen.any(),
        )

    def _control(self, arm: Float[np.ndarray, " 7"], width: float, force: float = 0.0) -> Float[np.ndarray, " 9"]:
        """Commands of the actuators; the fingers' are springs, which are drawn further together to grip."""
        finger = width / 2 - force / models.FINGER_STIFFNESS
        return np.concatenate([arm, [finger, finger]])

    def shown(self) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"], Int[np.ndarray, "h w"]]:
        """The true depth of every pixel [m], infinite where nothing is, its surface's outward normal, and its owner: a
        body's slot, the target last, `SHELF`, `ROBOT_LINK` or `NOTHING`."""
        camera = self.workcell.camera
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        inverse = np.linalg.inv([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        rays = np.stack([column, row, np.ones_like(row)], axis=-1).reshape(-1, 3) @ inverse.T
        rays = rays @ np.array(camera.rotation, float).T
        length = np.linalg.norm(rays, axis=1)
        data = mujoco.MjData(self._seen)
        data.qpos[:] = self._world.positions
        mujoco.mj_forward(self._seen, data)
        geom, distance = np.full(len(rays), -1, np.int32), np.zeros(len(rays))
        normal = np.zeros(3 * len(rays))
        eye, unit, groups = np.array(camera.position), (rays / length[:, None]).ravel(), SHOWN_GROUPS
        mujoco.mj_multiRay(self._seen, data, eye, unit, groups, 1, -1, geom, distance, normal, len(rays), FARTHEST)
        shape = (camera.height, camera.width)
        depth = np.where(geom >= 0, distance / length, np.inf)
        return depth.reshape(shape), normal.reshape(*shape, 3), self._owner[geom].reshape(shape)


def _owner(geometry: str) -> int:
    """Owner of a geometry of the model: a body's slot, the shelf or the robot."""
    slot = geometry.lstrip("abcdefghijklmnopqrstuvwxyz")
    if slot.isdigit() and geometry:
        return int(slot)
    return SHELF if geometry.endswith("_box") else ROBOT_LINK
