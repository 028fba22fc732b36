"""The shelf at one moment as recognisers see it, and the recognisers that return the true state."""

from __future__ import annotations

import dataclasses
import functools
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.envs.camera.sensing import Sensing, as_seen, resized, sensed_depth, true_camera
from mechsearch_jax.envs.camera.simulated_camera import Image, is_found, observe, target_window, window_of
from mechsearch_jax.envs.world.world import BODIES, TARGET, World, plain_objects, true_superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.cloud import View, thinned_view
from mechsearch_jax.images.measured import measured_share
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.assignment import assign
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# What is recognised farther than this from a body stands for another one, or for none [m].
NEAR = 0.1
# What is taken for the target farther than this from it is something else: a target's width and a half [m].
NEAR_TARGET = 0.03
# Share of the pixels of a body without which nothing is known of it.
NEARLY = 0.05


class Sight(PyTreeNode):
    """The part of a camera's view of a shelf that array shapes depend on, computed on the host.

    Attributes:
      view: see `thinned_view`; None if the camera does not see all of the shelf.
      window: see `target_window`; static.
    """

    view: View | None
    window: int = static()


def sight_of(camera: Camera, shelf: Shelf, target: Target | None = None) -> Sight:
    """The `Sight` that recognisers need where camera and shelf are traced; the arguments here must not be traced.

    Args:
      camera, shelf: of the problem.
      target: which the detector looks for; the usual one if None.
    """
    try:
        view = thinned_view(camera, shelf)
    except InputError:
        # The oracle needs no view.
        view = None
    if target is None or target.compound is None:
        return Sight(view, target_window(camera))
    return Sight(view, target_window(camera, target.half_size))


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """The shelf at one moment, as the camera can see it; images are ray-cast lazily.

    Attributes:
      camera, shelf: of the problem.
      world: the true state.
      sight: of camera and shelf; required where they are traced.
      sensing: how what is seen differs from what the problem says; None if it does not.
    """

    camera: Camera
    shelf: Shelf
    world: World
    sight: Sight | None = None
    sensing: Sensing | None = None

    @property
    def view(self) -> View:
        """The part of the image that networks are shown; see `thinned_view`.

        Raises:
          InputError: the camera does not see the shelf.
        """
        if self.sight is None:
            return thinned_view(self.camera, self.shelf)
        if self.sight.view is None:
            raise InputError("snapshot: the camera does not look into the shelf; check its pose")
        return self.sight.view

    @functools.cached_property
    def image(self) -> Image:
        """Depth, segmentation and colour at full resolution."""
        return observe(true_camera(self.camera, self.sensing), self.world, self.shelf)

    @functools.cached_property
    def target_seen(self) -> Bool[Array, ""]:
        """Whether the detector finds the target in the image; much cheaper than casting the image."""
        window = window_of(self.camera, self.world) if self.sight is None else self.sight.window
        return is_found(true_camera(self.camera, self.sensing), self.world, window)

    @property
    def target_pose(self) -> Float[Array, " 3"]:
        """x, y [m] and yaw [rad] of the target, where it seems to be to the planner."""
        return true_target_pose(as_seen(self.world, self.sensing))


@runtime_checkable
class Recogniser(Protocol):
    """Turns what the camera sees into an observation for the planner; must be traceable by JAX to run in batches."""

    def __call__(self, key: Array, snapshot: Snapshot) -> Observation: ...


@runtime_checkable
class Detects(Protocol):
    """A recogniser that sees images alone: it may take the target for visible where it is not, or not where it is, and
    numbers objects as it likes."""

    @property
    def detects_target(self) -> bool: ...


class Truth(PyTreeNode):
    """What a look truly shows, for verdicts and records; the planner does not know it.

    Attributes:
      shown: whether what was taken for the target last was the target, in sight, or came from the truth anyway.
      bodies: the number of the body that each recognised object stands for, each number once, int32, shape (8,).
      there: whether it stands for that body; one that stands for none has the number of an empty slot, if there is
        one, shape (8,).
    """

    shown: jax.Array
    bodies: jax.Array
    there: jax.Array

    def since(self, before: Truth, observation: Observation) -> Truth:
        """The truth of this look after earlier ones: where nothing is taken for the target, `shown` stays."""
        return self.replace(shown=jnp.where(observation.target_visible, self.shown, self.shown | before.shown))


def truth_of(recogniser: Recogniser, snapshot: Snapshot, observation: Observation) -> Truth:
    """The truth of a look, at which a recogniser made an observation.

    The recognisers that know the truth have its numbers. Of the others the bodies are those that are nearest.
    """
    if not detects(recogniser):
        return truth_unseen(shown=True)
    bodies, there = nearest_bodies(as_seen(snapshot.world, snapshot.sensing), observation.objects)
    return Truth(is_the_target(snapshot, observation), bodies, there)


def truth_unseen(shown: bool = False) -> Truth:
    """The truth where objects have the numbers of bodies."""
    return Truth(jnp.array(shown), jnp.arange(TARGET, dtype=jnp.int32), jnp.ones(TARGET, bool))


def detects(recogniser: Recogniser) -> bool:
    """Whether a recogniser detects the target in images, and may take something else for it."""
    return isinstance(recogniser, Detects) and recogniser.detects_target


def is_the_target(snapshot: Snapshot, observation: Observation) -> Bool[Array, ""]:
    """Whether the target is detected where it is, and truly in sight."""
    apart = observation.target_pose[:2] - snapshot.target_pose[:2]
    return observation.target_visible & snapshot.target_seen & (jnp.sum(apart**2) < NEAR_TARGET**2)


@cached_jit()
def nearest_bodies(world: World, objects: Superquadrics) -> tuple[Int[Array, " 8"], Bool[Array, " 8"]]:
    """The number of a body for each of eight objects, each number once, and whether the object stands for that body.

    The sum of the distances of centres is least, where those above `NEAR` count as that. Objects that stand for no body
    have the numbers of empty slots, if there are any.
    """
    bodies = true_superquadrics(world)
    apart = jnp.linalg.norm(objects.position[:, None] - bodies.position[None], axis=-1)
    near = objects.valid[:, None] & bodies.valid[None] & (apart < NEAR)
    # An object that is none takes what the others leave.
    wrong = jnp.where(bodies.valid, 2 * NEAR, NEAR)[None]
    numbers = assign(jnp.where(objects.valid[:, None], jnp.where(near, apart, wrong), 0.0))
    return numbers, jnp.take_along_axis(near, numbers[:, None], axis=1)[:, 0]


def oracle(key: Array, snapshot: Snapshot) -> Observation:
    """The `Recogniser` of the true shapes and poses; the target's once the detector sees it. Ignores the key.

    Of a camera that is not where the planner takes it to be, the poses are those that the planner sees.
    """
    objects, detected, depth = _seen_objects(snapshot)
    measured = None if depth is None else measured_share(snapshot.camera, snapshot.view, depth)
    seen = Observation(objects, snapshot.target_seen & detected, snapshot.target_pose, measured=measured)
    return seen.judged()


def informed(key: Array, snapshot: Snapshot) -> Observation:
    """The `Recogniser` of the true shapes and poses, and of the target's pose whether or not it can be seen.

    An upper bound on searching: the target counts as visible in every observation, so that it is found from the start.
    Ignores the key.
    """
    return Observation(_seen_objects(snapshot)[0], jnp.array(True), snapshot.target_pose).judged()


def _seen_objects(snapshot: Snapshot) -> tuple[Superquadrics, Bool[Array, ""], Float[Array, "h w"] | None]:
    """The true objects on the board, where they seem to be to the planner, and as large.

    Those that lie in holes of the depth are left out.

    Returns:
      The objects, whether enough of the target has depth to be detected, and the view's depth, None without holes.

    Raises:
      InputError: depth or colour are measured otherwise, which without an image would change nothing.
    """
    if snapshot.sensing is not None and snapshot.sensing.noise is not None:
        raise InputError("sensor, depth_noise and missing_depth need an image; take the recogniser masks or full")
    if snapshot.sensing is not None and snapshot.sensing.colour is not None:
        raise InputError("colour_noise, exposure, white_balance and hue_gap need an image; take the recogniser full")
    objects = as_seen(resized(objects_on_the_board(snapshot), snapshot.sensing), snapshot.sensing)
    if snapshot.sensing is None or snapshot.sensing.holes is None:
        return objects, jnp.array(True), None
    view = snapshot.view
    depth, lost, pixels = in_holes(view, snapshot.world, snapshot.shelf, snapshot.sensing)
    measured = pixels > found_pixels(snapshot.camera) / view.stride**2
    return objects.replace(valid=objects.valid & ~lost[:TARGET]), measured, depth


@cached_jit()
def in_holes(
    view: View, world: World, shelf: Shelf, sensing: Sensing
) -> tuple[Float[Array, "h w"], Bool[Array, " 9"], Int[Array, ""]]:
    """What the holes of an episode leave of an image.

    Args:
      view: which rays of a camera are cast.
      world: the true state.
      shelf: the shelf in the image.
      sensing: of the episode, with holes.

    Returns:
      The depth, as of `sensed_depth`; which bodies have none, or none but for `NEARLY` of what the image shows of them;
      and how many pixels of the target have one.
    """
    assert sensing.holes is not None
    image = observe(true_camera(view.camera, sensing), world, shelf)
    depth = sensed_depth(view.camera, world, image, sensing)
    is_shown = image.segmentation.reshape(-1, 1) == jnp.arange(BODIES)[None]
    shown, measured = (jnp.sum(is_shown & where, axis=0) for where in (True, jnp.isfinite(depth).reshape(-1, 1)))
    lost = sensing.holes.without_depth(world) | ((shown > 0) & (measured <= NEARLY * shown))
    return depth, lost, measured[TARGET]


def objects_on_the_board(snapshot: Snapshot) -> Superquadrics:
    """The true objects, without those that have fallen off the board; without parts where none is a compound."""
    return _on_the_board(plain_objects(snapshot.world), snapshot.shelf)


@cached_jit()
def _on_the_board(world: World, shelf: Shelf) -> Superquadrics:
    scene = true_superquadrics(world)
    fallen = (scene.position[:, 0] < shelf.front) | (scene.position[:, 2] < shelf.board)
    return scene.replace(valid=scene.valid & ~fallen)


@cached_jit()
def true_target_pose(world: World) -> Float[Array, " 3"]:
    """x, y [m] and yaw [rad] of the target."""
    R, t = world.rotation[TARGET], world.position[TARGET]
    return jnp.stack([t[0], t[1], jnp.arctan2(R[1, 0], R[0, 0])])
