"""Model mismatch: how far a simulated world is from what the planner and its trials assume (docs/method.md,
"Model mismatch").

The world's frame is that of the true shelf. The planner's frame is the robot's base, from which it takes the shelf to
stand where its workcell says, and the camera to look from where its workcell says.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.config.config import Option
from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.runtime.options import option
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf

PhysicsName = Literal["usual", "fine-step", "coarse-step", "soft-contacts", "soft-friction", "pyramidal-cone"]
HolesName = Literal["none", "objects", "shadows", "scattered", "target", "patches"]
SensorName = Literal["ideal", "structured-light", "active-stereo", "time-of-flight"]

# Largest shift of camera and shelf [m], and largest turn [degrees].
FARTHEST, STEEPEST = 0.2, 20.0
# Largest error at which an arm stops [rad].
LARGEST_STOP = 1.0
# Standard deviation of the usual depth noise [m].
USUAL_NOISE = 0.001
# Standard deviation of the usual noise in each channel of colour, 4 of 255.
USUAL_COLOUR_NOISE = 0.016
# The usual least difference of the objects' hues from the target's [degrees].
USUAL_HUE_GAP = 40.0


@dataclasses.dataclass(frozen=True)
class Mismatch:
    """How a simulated world differs from what the planner and its trials assume; by default not at all. Hashable.

    Shifts have a random direction, turns a random axis; see `drawn`.

    Attributes:
      friction: factor on all sliding frictions.
      mass: factor on the masses and inertias of all bodies on the shelf.
      friction_spread, mass_spread: each body's sliding friction, and its mass and inertia, are multiplied by a further
        factor of its own, between 1 / spread and spread; its logarithm is uniformly distributed. 1: none.
      size_spread: the same of the width, depth and height with which each object is recognised where true shapes are;
        its lowest point stays.
      physics: contacts and time step of the simulation, one of `simulators.native.PHYSICS`.
      arm_stop: an arm with a joint farther than this from its reference stops and goes back the way it came [rad]; 0:
        it goes on, as trials take it to. Ordinary actions reach 0.027.
      camera_shift, camera_turn: how far the camera stands [m], and how far it is turned about itself [degrees], from
        where the planner takes it to be.
      shelf_shift, shelf_turn: the same of robot base and camera together against the shelf and all that is on it: a
        shift [m], and a turn [degrees] about the middle of the board.
      depth_noise: standard deviation of the measured points' distance from the true ones [m].
      missing_depth: share of pixels without a measurement, below 1.
      colour_noise: standard deviation of each channel of the colour image, in shares of full brightness.
      exposure: factor on all channels of the colour image.
      white_balance: share by which red is too strong in it and blue too weak.
      hue_gap: least difference of the objects' hues from the target's [degrees]; 0 for any colour.
      holes: connected parts of the image without depth, by the name of one of `holes.HOLES`; `oracle` and `informed` do
        not know what lies in them either.
      sensor: the depth camera, by the name of one of `sensors.SENSORS`; only `ideal` has `depth_noise`.
    """

    friction: float = option(1.0, "factor on the simulated world's sliding frictions")
    mass: float = option(1.0, "factor on the masses of the simulated bodies")
    friction_spread: float = option(
        1.0, "each body's friction is drawn between this many times less and more than it would be"
    )
    mass_spread: float = option(1.0, "each body's mass is drawn between this many times less and more than it would be")
    size_spread: float = option(
        1.0, "each true width, depth and height is recognised between this many times smaller and larger than it is"
    )
    physics: PhysicsName = option("usual", "contacts and time step of the simulated world", get_args(PhysicsName))
    arm_stop: float = option(
        0.0,
        "joint error at which the simulated arm stops and goes back [degrees], 1.7 or more; 0: never",
        least_degrees=0.2,
    )
    camera_shift: float = option(0.0, "how far the camera stands from where it is taken to be [m]")
    camera_turn: float = option(0.0, "by how much the camera is turned about itself [degrees]")
    shelf_shift: float = option(0.0, "how far the shelf stands from where it is taken to be [m]")
    shelf_turn: float = option(0.0, "by how much the shelf is turned about its middle [degrees]")
    depth_noise: float = option(
        USUAL_NOISE,
        "standard deviation by which noise moves points in a random direction, of which depth shows a part [m]",
    )
    missing_depth: float = option(0.0, "share of pixels for which no depth is measured")
    colour_noise: float = option(USUAL_COLOUR_NOISE, "standard deviation of the colour camera's noise, from 0 to 1")
    exposure: float = option(1.0, "factor on the brightness of the simulated colour image")
    white_balance: float = option(0.0, "share by which red is too strong and blue too weak in the colour image")
    hue_gap: float = option(USUAL_HUE_GAP, "least difference of the objects' hues from the target's [degrees]")
    holes: HolesName = option(
        "none", "what the simulated depth camera does not measure, in connected holes", get_args(HolesName)
    )
    sensor: SensorName = option("ideal", "what kind of depth camera is simulated", get_args(SensorName))

    def __post_init__(self):
        for name, low, high, unit in (
            ("friction", 0.01, 100.0, ""),
            ("mass", 0.01, 100.0, ""),
            ("friction_spread", 1.0, 10.0, ""),
            ("mass_spread", 1.0, 10.0, ""),
            ("size_spread", 1.0, 2.0, ""),
            ("arm_stop", 0.0, LARGEST_STOP, "rad"),
            ("camera_shift", 0.0, FARTHEST, "m"),
            ("camera_turn", 0.0, STEEPEST, "degrees"),
            ("shelf_shift", 0.0, FARTHEST, "m"),
            ("shelf_turn", 0.0, STEEPEST, "degrees"),
            ("depth_noise", 0.0, 1.0, "m"),
            ("missing_depth", 0.0, 0.99, ""),
            ("colour_noise", 0.0, 1.0, ""),
            ("exposure", 0.01, 100.0, ""),
            ("white_balance", -0.9, 0.9, ""),
            ("hue_gap", 0.0, 180.0, "degrees"),
        ):
            check_range(f"Mismatch: {name}", getattr(self, name), low, high, unit)
            # Convert to one type, for rows keep what was given.
            object.__setattr__(self, name, float(getattr(self, name)))
        for name, kind in (("physics", PhysicsName), ("holes", HolesName), ("sensor", SensorName)):
            if (given := getattr(self, name)) not in get_args(kind):
                raise InputError(f'Mismatch: {name} "{given}" is unknown; use {", ".join(get_args(kind))}')
        if self.sensor != "ideal" and self.depth_noise != USUAL_NOISE:
            raise InputError(f"Mismatch: depth_noise is of sensor ideal; {self.sensor} has its own, leave it out")

    @property
    def moves_robot(self) -> bool:
        """Whether the robot does not stand where the planner takes it to."""
        return bool(self.shelf_shift or self.shelf_turn)

    @property
    def moves_camera(self) -> bool:
        """Whether the camera does not see the shelf from where the planner takes it to."""
        return bool(self.moves_robot or self.camera_shift or self.camera_turn)

    @property
    def resizes(self) -> bool:
        """Whether objects are recognised larger or smaller than they are."""
        return self.size_spread > 1.0

    @property
    def measures_otherwise(self) -> bool:
        """Whether measured depth differs from the usual."""
        return (self.sensor, self.depth_noise) != ("ideal", USUAL_NOISE) or self.missing_depth > 0.0

    @property
    def colours_otherwise(self) -> bool:
        """Whether the colour image differs from the usual."""
        usual = USUAL_COLOUR_NOISE, 1.0, 0.0, USUAL_HUE_GAP
        return (self.colour_noise, self.exposure, self.white_balance, self.hue_gap) != usual

    @property
    def simulates_otherwise(self) -> bool:
        """Whether the simulator has to differ from the usual."""
        usual = TrueCell()
        alike = (self.friction, self.mass, self.physics, self.arm_stop) == (*usual[:3], usual.arm_stop)
        return self.moves_robot or not alike or max(self.friction_spread, self.mass_spread) > 1.0

    def compile_key(self) -> Hashable:
        """A key of what is compiled: equal for mismatches that may share a batch."""
        has_holes = self.holes != "none"
        return self.moves_camera, self.resizes, self.measures_otherwise, self.colours_otherwise, has_holes

    def check(self, recognition: str, engine: str) -> None:
        """Check that episodes with a recogniser and a simulator, by their names, can have this mismatch.

        Raises:
          InputError: they cannot.
        """
        if recognition in ("oracle", "informed") and self.measures_otherwise:
            raise InputError("sensor, depth_noise and missing_depth need an image; add --recognition masks or full")
        if recognition not in ("oracle", "informed") and self.resizes:
            raise InputError(
                "size_spread: shapes from images are off by themselves; take --recognition oracle or informed"
            )
        if recognition not in ("full", "full-parts") and self.colours_otherwise:
            raise InputError(
                "colour_noise, exposure, white_balance and hue_gap need a colour image; add --recognition full"
            )
        if engine != "NativeSimulator" and self.physics != "usual":
            raise InputError("physics: the batch simulator has the usual physics; add --simulator native")
        if engine != "NativeSimulator" and self.arm_stop:
            raise InputError("arm_stop: the batch simulator's arm never stops; add --simulator native")

    def drawn(self, scenario: Scenario, seed: int, camera: Camera, shelf: Shelf) -> TrueCell:
        """The cell of an episode, constant until its end.

        Directions, axes, the bodies' shares of a spread and the seed of holes are drawn from what the scenario holds
        and the episode's seed. They do not depend on how far anything is shifted or turned, or on the spread, so that a
        sweep compares like with like.

        Args:
          scenario, seed: of the episode.
          camera, shelf: as the planner takes them to be.
        """
        random = np.random.default_rng([abs(seed), int(scenario.content_hash, 16)])
        vectors = random.normal(size=(4, 3))
        camera_way, camera_axis, shelf_way, shelf_axis = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        middle = np.array([(shelf.front + shelf.back) / 2, (shelf.right + shelf.left) / 2, shelf.board])
        friction_share, mass_share = random.uniform(-1.0, 1.0, size=(2, BODIES))
        size_share = random.uniform(-1.0, 1.0, size=(BODIES, 3))
        # To move robot and camera one way is to move the shelf the other way.
        T_world_base = _motion(-self.shelf_shift * shelf_way, -self.shelf_turn * shelf_axis, middle)
        T_base_moved = _motion(
            self.camera_shift * camera_way, self.camera_turn * camera_axis, np.array(camera.position)
        )
        return TrueCell(
            self.friction,
            self.mass,
            self.physics,
            T_world_base,
            T_base_moved,
            self.arm_stop,
            self.friction_spread**friction_share,
            self.mass_spread**mass_share,
            self.size_spread**size_share,
            int(random.integers(2**32)),
        )


class TrueCell(NamedTuple):
    """The cell of one episode; by default as the planner assumes.

    Attributes:
      friction, mass, physics: as of `Mismatch`.
      T_world_base: where the robot's base stands; the identity where the planner takes it to.
      T_base_moved: what moves the camera, in the base's frame, from where the planner takes it to be to where it is.
      arm_stop: as of `Mismatch`.
      body_friction, body_mass: further factors on the sliding friction, and on mass and inertia, of each body.
      seen_size: factors on each body's width, depth and height as they are recognised.
      holes_seed: of what is drawn for the camera's holes.
    """

    friction: float = 1.0
    mass: float = 1.0
    physics: PhysicsName = "usual"
    T_world_base: Float[np.ndarray, "4 4"] = np.eye(4)
    T_base_moved: Float[np.ndarray, "4 4"] = np.eye(4)
    arm_stop: float = 0.0
    body_friction: Float[np.ndarray, " 9"] = np.ones(BODIES)
    body_mass: Float[np.ndarray, " 9"] = np.ones(BODIES)
    seen_size: Float[np.ndarray, "9 3"] = np.ones((BODIES, 3))
    holes_seed: int = 0


# As the planner assumes.
ASSUMED = Mismatch()
ASSUMED_CELL = TrueCell()


def _motion(shift: np.ndarray, turn: np.ndarray, pivot: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """The motion that turns about a point by a rotation vector [degrees], and shifts [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(turn)).as_matrix()
    T[:3, 3] = pivot - T[:3, :3] @ pivot + shift
    return T


# By the name that `--world` has for them; paths lead from a `Mismatch`.
MISMATCH_OPTIONS: Mapping[str, Option] = {
    field.name: Option.of_field(field, float) for field in dataclasses.fields(Mismatch)
}
