"""Random scenes, generated and ray-cast into images of points on the accelerator; all functions are vmappable."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.camera.colour_image import scene_key
from mechsearch_jax.envs.camera.recognisers import true_labels
from mechsearch_jax.envs.camera.sensors import SENSORS, Sensor, surfaces_of
from mechsearch_jax.envs.camera.simulated_camera import SHELF, cast_body, cast_shelf
from mechsearch_jax.envs.scenes.generator import CATALOGUE
from mechsearch_jax.envs.world.world import BODIES, TARGET, World
from mechsearch_jax.geometry.transforms import matmul, rotate, yaw_rotation
from mechsearch_jax.images.cloud import View, shelf_view
from mechsearch_jax.images.labels import OTHER
from mechsearch_jax.images.noise import NoiseModel, RandomDirection, TimeOfFlight, no_noise
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import by_shape, shape_of
from mechsearch_jax.train.places import Places, draw_camera, draw_place
from mechsearch_jax.train.vessels import Form, cut_round
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Steps of `_slide`; each shortens the gap to at most about a third.
_SLIDES = 8
# Least number of pixels of the full image of an object that is scored.
PIXELS = 100
# Most objects in a scene, and most that stand on each other.
MOST, HIGHEST = 16, 3
# Where the middle of an object may be on the top of another, as a share of its half-extents.
_OVERHANG = 0.6
# Lengths below which heights are equal, and least distance of tops from the upper board [m].
_EQUAL, _BELOW_CEILING = 1e-5, 0.005
# Codes of the shapes of objects of random size, in an order that must not change: random numbers index it. Then the
# targets, and codes and half-extents of the paper's objects.
_OBJECT_KINDS = np.array([shape_of(name).code for name in ("box", "cylinder")], np.int32)
_TARGETS = tuple(Target.of(name) for name in ("cylinder", "box"))
_CATALOGUE = np.array(
    [(shape_of(name).code, *half) for name, (x, y, z) in CATALOGUE for half in ((x, y, z), (y, x, z))], np.float32
)


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """Distribution of scenes. Sizes are full sizes [m]; ranges are sampled log-uniformly.

    Attributes:
      objects: least and largest number of objects; objects without room are left out.
      known: share of objects that are one of the paper's eleven.
      sides: range of the width and depth of objects that are not round.
      heights: range of heights.
      diameters: range of the diameter of round objects.
      lying: share of objects that lie on their side.
      leaning: share of objects that lean, none of whose faces is level.
      lean: range of the angle by which they lean [rad].
      touching: share of objects that are pushed against another.
      target: share of scenes with a target, whose points belong to no object.
      placements: number of places that are tried at once for an object.
      noises: each scene's sensor is one of these, drawn uniformly.
      stacked: share of objects that stand on another, if there is one with room, up to three high.
      propped: share of leaning objects that lean against another.
      tapered: share of round objects whose radius shrinks towards an end.
      taper: range of the smaller radius, as a share of the larger; uniform.
      hollow: share of round objects that are open at the top.
      wall: range of the thickness of their walls [m].
      places: other shelves, table tops and cameras; the given shelf and view if None.
      also: another distribution, of objects and their arrangement on the given shelf from the given view ...
      share: ... of so many of the scenes, with the sensors of this one.
    """

    objects: tuple[int, int] = (2, 8)
    known: float = 0.5
    sides: tuple[float, float] = (0.022, 0.17)
    heights: tuple[float, float] = (0.04, 0.23)
    diameters: tuple[float, float] = (0.03, 0.1)
    lying: float = 0.07
    leaning: float = 0.03
    lean: tuple[float, float] = (0.05, 0.6)
    touching: float = 0.2
    target: float = 0.3
    placements: int = 24
    noises: tuple[NoiseModel, ...] = (no_noise, RandomDirection(), TimeOfFlight())
    stacked: float = 0.0
    propped: float = 0.0
    tapered: float = 0.0
    taper: tuple[float, float] = (0.6, 1.0)
    hollow: float = 0.0
    wall: tuple[float, float] = (0.002, 0.006)
    places: Places | None = None
    also: SceneConfig | None = None
    share: float = 0.5

    @classmethod
    def real(cls, touching: float = 0.4) -> SceneConfig:
        """Tables and shelves as people have them; half of the scenes are of the default distribution.

        Args:
          touching: as in `SceneConfig`, of both.
        """
        return cls(
            objects=(1, 12),
            known=0.1,
            sides=(0.02, 0.35),
            heights=(0.015, 0.35),
            diameters=(0.03, 0.2),
            lying=0.12,
            leaning=0.06,
            lean=(0.05, 0.7),
            touching=touching,
            target=0.15,
            noises=(Sensor(), *SENSORS.values()),
            stacked=0.35,
            propped=0.7,
            tapered=0.3,
            hollow=0.3,
            places=Places(),
            also=cls(touching=touching),
        )

    def __post_init__(self):
        low, high = self.objects
        if not 1 <= low <= high <= MOST:
            raise InputError(f"SceneConfig: objects {self.objects} must be a range within 1 to {MOST}")
        shares = ("stacked", "propped", "tapered", "hollow", "share")
        for name in ("known", "lying", "leaning", "touching", "target", *shares):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"SceneConfig: {name} {getattr(self, name)} must be between 0 and 1")
        for name in ("sides", "heights", "diameters", "lean", "taper", "wall"):
            if not 0 < getattr(self, name)[0] <= getattr(self, name)[1]:
                raise InputError(f"SceneConfig: {name} {getattr(self, name)} must be a range of positive numbers")
        if self.placements < 1 or not self.noises:
            raise InputError("SceneConfig: placements must be at least 1 and noises not empty")
        if self.taper[1] > 1:
            raise InputError(f"SceneConfig: taper {self.taper} must be at most 1")
        if self.also is not None and self.also.slots > self.slots:
            raise InputError(f"SceneConfig: also has more objects than {self.objects}")

    @property
    def slots(self) -> int:
        """Slots for objects in a world; those beyond eight follow the target's."""
        return max(TARGET, self.objects[1])

    @property
    def has_forms(self) -> bool:
        """Whether bodies may have a `Form`."""
        return self.tapered > 0 or self.hollow > 0


def origin(config: SceneConfig) -> dict[str, Any]:
    """The source of examples from these scenes, for the card of a network's weights."""
    noises = [
        repr(noise) if name == type(noise).__name__ else name
        for noise, name in zip(config.noises, noise_names(config), strict=True)
    ]
    card = dataclasses.asdict(dataclasses.replace(config, noises=("none",), also=None)) | {"noises": noises}
    card["also"] = None if config.also is None else origin(config.also)
    return {"source": "random scenes, ray-cast as they were needed", **card}


class Footprint(PyTreeNode):
    """Footprints of bodies, seen from above: a rectangle, or a disc if `radius` is not 0.

    Attributes:
      centre: [m], shape (..., 2).
      half: half-extents of the rectangle along its own axes [m], shape (..., 2); 0 for a disc.
      yaw: of the rectangle [rad], shape (...).
      radius: of the disc [m], shape (...).
    """

    centre: jax.Array
    half: jax.Array
    yaw: jax.Array
    radius: jax.Array


def _axes(yaw: Array) -> Array:
    """A rectangle's axes as rows, shape (..., 2, 2)."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([jnp.stack([c, s], axis=-1), jnp.stack([-s, c], axis=-1)], axis=-2)


def gap(a: Footprint, b: Footprint) -> Float[Array, "..."]:
    """A lower bound of the distance between footprints [m]; positive exactly if they are apart.

    For rectangles it is the gap along the axis that separates them most, exact if one side faces the other; for discs
    it is exact.
    """
    offset = b.centre - a.centre
    axes_a, axes_b = _axes(a.yaw), _axes(b.yaw)

    def along(axes):
        reach = sum(
            jnp.sum(jnp.abs(jnp.sum(axes[..., :, None, :] * rows[..., None, :, :], axis=-1)) * f.half[..., None, :], -1)
            for f, rows in ((a, axes_a), (b, axes_b))
        )
        return jnp.max(jnp.abs(jnp.sum(axes * offset[..., None, :], axis=-1)) - reach, axis=-1)

    def to_rectangle(axes, half):
        outside = jnp.abs(jnp.sum(axes * offset[..., None, :], axis=-1)) - half
        return jnp.linalg.norm(jnp.maximum(outside, 0.0), axis=-1) + jnp.minimum(jnp.max(outside, axis=-1), 0.0)

    rectangles = jnp.maximum(along(axes_a), along(axes_b))
    round_a, round_b = a.radius > 0, b.radius > 0
    mixed = jnp.where(round_a, to_rectangle(axes_b, b.half), to_rectangle(axes_a, a.half))
    discs = jnp.linalg.norm(offset, axis=-1)
    apart = jnp.where(round_a & round_b, discs, jnp.where(round_a | round_b, mixed, rectangles))
    return apart - a.radius - b.radius


class _Shape(PyTreeNode):
    """A body at the origin, its lowest point at height 0: shape, orientation and footprint.

    `height` is that of its centre. With `leans` no face is level, and with `flat` something can stand on it.
    """

    kind: jax.Array
    half_size: jax.Array
    rotation: jax.Array
    height: jax.Array
    half: jax.Array
    radius: jax.Array
    leans: jax.Array
    flat: jax.Array


def _log_uniform(key: Array, limits: tuple[float, float], shape: tuple[int, ...] = ()) -> Array:
    return jnp.exp(jax.random.uniform(key, shape, minval=np.log(limits[0]), maxval=np.log(limits[1])))


def _tilt(angle: Array) -> Array:
    """Rotation about the x axis."""
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([jnp.stack(r) for r in ([one, zero, zero], [zero, c, -s], [zero, s, c])])


def _draw_shape(key: Array, config: SceneConfig) -> _Shape:
    """A random body, before its yaw is applied."""
    keys = jax.random.split(key, 8)
    of_catalogue = jnp.array(_CATALOGUE)[jax.random.randint(keys[0], (), 0, len(_CATALOGUE))]
    is_catalogue = jax.random.bernoulli(keys[1], config.known)
    drawn = jnp.asarray(_OBJECT_KINDS)[jax.random.randint(keys[2], (), 0, len(_OBJECT_KINDS))]
    kind = jnp.where(is_catalogue, of_catalogue[0].astype(jnp.int32), drawn)
    width, depth = _log_uniform(keys[3], config.sides, (2,)) / 2
    radius = _log_uniform(keys[4], config.diameters) / 2
    height = _log_uniform(keys[5], config.heights) / 2
    is_round = by_shape(kind, lambda shape: shape.round, jnp)
    free = jnp.where(is_round, jnp.stack([radius, radius, height]), jnp.stack([width, depth, height]))
    half = jnp.where(is_catalogue, of_catalogue[1:], free)
    pose = jax.random.uniform(keys[6])
    angle = jnp.where(
        pose < config.leaning,
        jax.random.uniform(keys[7], minval=config.lean[0], maxval=config.lean[1]),
        jnp.where(pose < config.leaning + config.lying, jnp.pi / 2, 0.0),
    )
    rotation = _tilt(angle)
    return _shape(kind, half, rotation)


def _shape(kind: Array, half: Array, rotation: Array) -> _Shape:
    extent = by_shape(kind, lambda shape: shape.reach(rotation, half[None, :], jnp), jnp)
    is_round = by_shape(kind, lambda shape: shape.round, jnp)
    standing = is_round & (rotation[2, 2] > 0.999)
    leans = jnp.max(jnp.abs(rotation[2])) < 0.999
    return _Shape(
        kind,
        half,
        rotation,
        extent[2],
        jnp.where(standing, 0.0, extent[:2]),
        jnp.where(standing, half[0], 0.0),
        leans,
        jnp.where(is_round, standing, ~leans),
    )


def _draw_form(key: Array, shape: _Shape, config: SceneConfig) -> Form:
    """A random form; open vessels are wider at the top, and never upside down."""
    keys = jax.random.split(key, 5)
    is_round = by_shape(shape.kind, lambda shape: shape.round, jnp)
    small = jax.random.uniform(keys[0], minval=config.taper[0], maxval=config.taper[1])
    small = jnp.where(is_round & jax.random.bernoulli(keys[1], config.tapered), small, 1.0)
    hollow = is_round & jax.random.bernoulli(keys[2], config.hollow)
    wall = jnp.minimum(_log_uniform(keys[3], config.wall), jnp.min(shape.half_size) / 4)
    wider_below = jax.random.bernoulli(keys[4]) & ~hollow
    return Form(jnp.where(wider_below, 1.0, small), jnp.where(wider_below, small, 1.0), jnp.where(hollow, wall, 0.0))


def _solid(bodies: int) -> Form:
    return Form(jnp.ones(bodies), jnp.ones(bodies), jnp.zeros(bodies))


def _slide(moving: Footprint, other: Footprint) -> Footprint:
    """The footprint moved towards another until they almost touch; `gap` bounds each step from below."""

    def step(_, moved):
        offset = other.centre - moved.centre
        towards = offset / jnp.maximum(jnp.linalg.norm(offset), 1e-6)
        return moved.replace(centre=moved.centre + towards * jnp.maximum(gap(moved, other), 0.0))

    return jax.lax.fori_loop(0, _SLIDES, step, moving)


def _row(vector: Array, like: Array) -> Array:
    return vector.reshape(*[1] * (like.ndim - 1), -1)


def _spawn(shelf: Shelf) -> tuple[tuple[Any, Any, float], ...]:
    """The corners of the area where objects are dropped, and how far beyond those their centres may come."""
    return (shelf.spawn_x[0], shelf.spawn_y[0], -0.01), (shelf.spawn_x[1], shelf.spawn_y[1], 0.01)


def _within(shelf: Shelf, footprint: Footprint, around: Shelf, clearance: float = 0.002) -> Array:
    """Whether a footprint lies on the board around, and its centre in the area where objects are dropped."""
    centre = footprint.centre
    reach = jnp.sum(jnp.abs(jnp.swapaxes(_axes(footprint.yaw), -1, -2)) * footprint.half[..., None, :], axis=-1)
    reach = reach + footprint.radius[..., None]
    low, high = centre - reach, centre + reach
    on_board = (low[..., 0] > around.front) & (high[..., 0] < around.back - clearance)
    on_board &= (low[..., 1] > around.right + clearance) & (high[..., 1] < around.left - clearance)
    low, high = (jnp.stack([jnp.float32(x + by), jnp.float32(y + by)]) for x, y, by in _spawn(shelf))
    centred = (centre > _row(low, centre)) & (centre < _row(high, centre))
    return on_board & centred.all(axis=-1)


def _draw_places(
    slot: Int[Array, ""], key: Key[Array, ""], shape: _Shape, config: SceneConfig, shelf: Shelf
) -> tuple[Footprint, Int[Array, " tries"], Bool[Array, ""]]:
    """Footprints where a body may stand, which body before it each may touch, and whether it is to touch one."""
    tries = config.placements
    low = jnp.array([shelf.spawn_x[0], shelf.spawn_y[0]])
    high = jnp.array([shelf.spawn_x[1], shelf.spawn_y[1]])
    draws, turns, pick, touch = jax.random.split(key, 4)
    centre = low[None] + (high - low)[None] * jax.random.uniform(draws, (tries, 2))
    yaw = jax.random.uniform(turns, (tries,), minval=-jnp.pi, maxval=jnp.pi)
    places = Footprint(centre, jnp.broadcast_to(shape.half, (tries, 2)), yaw, jnp.broadcast_to(shape.radius, (tries,)))
    neighbour = jax.random.randint(pick, (tries,), 0, jnp.maximum(slot, 1))
    return places, neighbour, jax.random.bernoulli(touch, config.touching)


def random_world(key: Key[Array, ""], config: SceneConfig | None = None, shelf: Shelf | None = None) -> World:
    """A random scene: bodies that rest on the board or on each other and do not overlap.

    Bodies are placed in sequence, each at one of `config.placements` random places; a body that fits nowhere is left
    out. An approximation: leaning bodies need not be supported by anything.

    Args:
      key: PRNG key.
      config: distribution of scenes, whose `places` and `also` are left out; static.
      shelf: the shelf; may be traced.

    Returns:
      The world; objects beyond eight have slots after the target's.
    """
    shelf = shelf or Shelf()
    return _arranged(key, config or SceneConfig(), shelf, shelf)[0]


def _arranged(key: Array, config: SceneConfig, shelf: Shelf, around: Shelf) -> tuple[World, Form, Array]:
    """A random world, its bodies' forms, and the height of what each stands on [m]; `around` holds the boards."""
    keys, last = jax.random.split(key, 5), config.slots
    bodies = last + 1
    count = jax.random.randint(keys[0], (), config.objects[0], config.objects[1] + 1)
    shapes = jax.vmap(lambda k: _draw_shape(k, config))(jax.random.split(keys[1], last))
    hidden = jax.random.randint(keys[2], (), 0, len(_TARGETS))
    target = _shape(
        jnp.array([shape_of(target.shape).code for target in _TARGETS])[hidden],
        jnp.array([target.half_size for target in _TARGETS], jnp.float32)[hidden],
        jnp.eye(3),
    )
    forms, (stacked, propped) = _solid(bodies), jnp.zeros((2, bodies), bool)
    if config.has_forms:
        drawn = jax.vmap(lambda k, shape: _draw_form(k, shape, config))
        forms = drawn(jax.random.split(jax.random.fold_in(key, 5), last), shapes)
        forms = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), forms, _solid(1))
    shapes = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), shapes, target)
    wanted = (jnp.arange(bodies) < count).at[last].set(jax.random.bernoulli(keys[3], config.target))
    if config.stacked or config.propped:
        chances = jax.random.uniform(jax.random.fold_in(key, 6), (2, bodies)).at[:, last].set(1.0)
        stacked = (chances[0] < config.stacked) & ~shapes.leans
        propped = (chances[1] < config.propped) & shapes.leans
    carries = shapes.flat & (forms.wall == 0) & (jnp.arange(bodies) < last)

    def place(placed, one_body):
        footprints, present, low, level = placed
        slot, wanted, height, stacks, props, (candidates, neighbour, touch) = one_body
        other = jax.tree.map(lambda a: a[neighbour], footprints)
        high, tall = low + 2 * shapes.height, 2 * height
        props = props & present[neighbour] & (level[neighbour] == 0) & (high[neighbour] > 0.6 * tall)
        offset = other.centre - candidates.centre
        # A leaning body's top is in the direction of its negative y axis.
        towards = jnp.arctan2(offset[:, 0], -offset[:, 1])
        candidates = candidates.replace(yaw=jnp.where(props, towards, candidates.yaw))
        beside = jax.vmap(_slide)(candidates, other)
        touches = (touch & present[neighbour]) | props
        # The random place in the area becomes one on the top of the other.
        (x, y, _), (far_x, far_y, _) = _spawn(shelf)
        start, size = jnp.stack([x, y]), jnp.stack([far_x - x, far_y - y])
        share = _OVERHANG * (2.0 * (candidates.centre - start[None]) / size[None] - 1.0)
        reach = jnp.where(other.radius[:, None] > 0, other.radius[:, None] / np.sqrt(2.0), other.half)
        on_top = other.centre + jnp.sum((share * reach)[:, :, None] * _axes(other.yaw), axis=1)
        raised = stacks & present[neighbour] & carries[neighbour] & (level[neighbour] < HIGHEST - 1)
        centre = jnp.where(touches[:, None], beside.centre, candidates.centre)
        candidates = candidates.replace(centre=jnp.where(raised[:, None], on_top, centre))
        bottom = jnp.where(raised, high[neighbour], 0.0)
        gaps = jax.vmap(lambda candidate: jax.vmap(lambda other: gap(candidate, other))(footprints))(candidates)
        above = bottom[:, None] > high[None] - _EQUAL
        below = bottom[:, None] + tall < low[None] + _EQUAL
        clear = jnp.all((gaps > 0.0) | above | below | ~present[None, :], axis=1)
        clear &= shelf.board + bottom + tall < around.ceiling - _BELOW_CEILING
        fits = clear & jax.vmap(lambda candidate: _within(shelf, candidate, around))(candidates)
        best = jnp.argmax(jnp.where(raised, 2, 1) * fits)
        chosen = jax.tree.map(lambda a: a[best], candidates)
        footprints = jax.tree.map(lambda a, b: a.at[slot].set(b), footprints, chosen)
        here = fits[best] & wanted
        rank = jnp.where(raised[best], level[neighbour[best]] + 1, 0)
        return (footprints, present.at[slot].set(here), low.at[slot].set(bottom[best]), level.at[slot].set(rank)), None

    nowhere = Footprint(jnp.zeros((bodies, 2)), jnp.zeros((bodies, 2)), jnp.zeros(bodies), jnp.zeros(bodies))
    # Random numbers are drawn for all bodies at once: only the places depend on earlier bodies.
    draw = jax.vmap(lambda slot, key, shape: _draw_places(slot, key, shape, config, shelf))
    drawn = draw(jnp.arange(bodies), jax.random.split(keys[4], bodies), shapes)
    start = (nowhere, jnp.zeros(bodies, bool), jnp.zeros(bodies), jnp.zeros(bodies, jnp.int32))
    each = (jnp.arange(bodies), wanted, shapes.height, stacked, propped, drawn)
    (footprints, present, low, _), _ = jax.lax.scan(place, start, each)
    height = shelf.board + low + shapes.height
    world = World(
        kind=shapes.kind,
        half_size=shapes.half_size,
        position=jnp.concatenate([footprints.centre, height[:, None]], axis=1),
        rotation=matmul(yaw_rotation(footprints.yaw), shapes.rotation),
        valid=present,
    )
    order = np.array([*range(TARGET), last, *range(TARGET, last)])
    return jax.tree.map(lambda a: a[order], (world, forms, shelf.board + low))


class Scene(PyTreeNode):
    """A scene and the camera that looks at it.

    Attributes:
      world: the bodies; those beyond the ninth are further objects.
      forms: how they differ from their shapes; None if they do not.
      support: height of what each body stands on [m].
      shelf: the space in which things are looked for.
      around: the boards in the image.
      camera: of the image.
    """

    world: World
    forms: Form | None
    support: jax.Array
    shelf: Shelf
    around: Shelf
    camera: Camera


def random_scene(
    key: Key[Array, ""], config: SceneConfig | None = None, shelf: Shelf | None = None, view: View | None = None
) -> Scene:
    """A random scene with its camera.

    Args:
      key: PRNG key.
      config: distribution of scenes; static.
      shelf, view: the shelf and the rays of its usual camera; another camera has an image of the same size.
    """
    config, shelf, camera = config or SceneConfig(), shelf or Shelf(), (view or shelf_view()).camera
    shelves, arranging, posing, others, pick = [key] * 5 if config.places is None else jax.random.split(key, 5)
    space = around = shelf
    is_table = jnp.array(False)
    if config.places is not None:
        space, around, is_table = draw_place(shelves, config.places, shelf)
    world, forms, support = _arranged(arranging, config, space, around)
    seen_from = camera
    if config.places is not None:
        seen_from = draw_camera(posing, config.places, world, space, is_table, camera)
    scene = Scene(world, forms if config.has_forms else None, support, space, around, seen_from)
    if config.also is None:
        return scene
    own, more = _arranged(others, config.also, shelf, shelf), config.slots - config.also.slots
    own = jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros((more, *a.shape[1:]), a.dtype)]), own)
    other = Scene(own[0], own[1] if config.has_forms else None, own[2], shelf, shelf, camera)
    chosen = jax.random.bernoulli(pick, config.share)
    return jax.tree.map(lambda a, b: jnp.where(chosen, jnp.asarray(a, jnp.asarray(b).dtype), b), other, scene)


class Capture(PyTreeNode):
    """A sensor's image of a scene.

    Attributes:
      points: as measured [m], shape (h, w, 3); NaN where nothing was measured.
      labels: int8, shape (h, w): 0 to 7 an object's slot, 8 the target, 9 and more a further object's slot, FREE the
        shelf, OTHER the shelf where noise has lifted it, MISSING nothing.
      pixels: number of pixels of each object, int32, shape (8,).
      alone: number of its pixels if it stood there alone.
      sensor: index of the noise in `SceneConfig.noises`.
    """

    points: jax.Array
    labels: jax.Array
    pixels: jax.Array
    alone: jax.Array
    sensor: jax.Array


def cast_world(
    camera: Camera, shelf: Shelf, world: World, forms: Form | None = None
) -> tuple[Float[Array, "h w"], Int[Array, "h w"], Int[Array, " bodies"]]:
    """Depth [m], the slot of the visible body (-1 for none), and each body's number of pixels if it were alone."""
    directions, bodies = rays(camera), len(world.valid)

    def nearer(slot, best):
        depth, owner, alone = best
        candidate = cast_body(camera, world, slot, directions)
        if forms is not None:
            candidate = jnp.where(is_round[slot], _cast_round(camera, world, forms, slot, directions), candidate)
        alone = alone.at[slot].set(jnp.sum(jnp.isfinite(candidate)))
        return jnp.minimum(depth, candidate), jnp.where(candidate < depth, slot.astype(jnp.int8), owner), alone

    behind = cast_shelf(camera, shelf, directions)
    none = jnp.full(behind.shape, -1, jnp.int8)
    is_round = by_shape(world.kind, lambda shape: shape.round, jnp)
    return jax.lax.fori_loop(0, bodies, nearer, (behind, none, jnp.zeros(bodies, jnp.int32)))


def _cast_round(camera: Camera, world: World, forms: Form, slot: Array, directions: Array) -> Array:
    """As `cast_body`, of a round body of some form."""
    # Row vectors times the matrix are in the body's frame.
    origin = matmul((jnp.array(camera.position) - world.position[slot])[None], world.rotation[slot])[0]
    towards = rotate(world.rotation[slot].T, directions)
    form = jax.tree.map(lambda a: a[slot], forms)
    depth = cut_round([*origin], [towards[..., i] for i in range(3)], world.half_size[slot], form)
    return jnp.where(world.valid[slot], depth, jnp.inf)


def object_pixels(owner: Int[Array, "h w"]) -> Int[Array, " objects"]:
    """Number of pixels of each of the eight objects, from the slots of the visible bodies."""
    return _pixels(owner, TARGET)


def _pixels(owner: Array, slots: int) -> Array:
    return jnp.sum(owner[..., None] == jnp.arange(slots).reshape(1, 1, -1), axis=(0, 1))


def capture(
    key: Key[Array, ""],
    world: World,
    config: SceneConfig | None = None,
    shelf: Shelf | None = None,
    view: View | None = None,
) -> Capture:
    """The image of a scene by one of the sensors of `config.noises`.

    Args:
      key: PRNG key.
      world: the scene.
      config: distribution of scenes; static.
      shelf: the shelf; static.
      view: which part of the camera's image, by default `shelf_view()`; static.
    """
    config, shelf = config or SceneConfig(), shelf or Shelf()
    camera = (view or shelf_view()).camera
    support = jnp.full(len(world.valid), shelf.board)
    return taken(key, Scene(world, None, support, shelf, shelf, camera), config)[1]


def taken(key: Key[Array, ""], scene: Scene, config: SceneConfig) -> tuple[Scene, Capture]:
    """The image of a scene by one of the sensors of `config.noises`, and the scene as the image numbers it.

    Of more than eight objects those with the most pixels have the first slots.
    """
    camera, shelf, world = scene.camera, scene.shelf, scene.world
    which, sensing = jax.random.split(key)
    depth, owner, alone = cast_world(camera, scene.around, world, scene.forms)
    bodies = len(world.valid)
    if bodies > BODIES:
        most = jnp.argsort(-(_pixels(owner, bodies).at[TARGET].set(-9)) - world.valid)[:-1]
        order = jnp.concatenate([most[:TARGET], jnp.array([TARGET]), most[TARGET:]])
        owner = jnp.where(owner < 0, owner, jnp.argsort(order)[owner]).astype(jnp.int8)
        world, forms, support, alone = jax.tree.map(lambda a: a[order], (world, scene.forms, scene.support, alone))
        scene = scene.replace(world=world, forms=forms, support=support)
    sensors = [noise for noise in config.noises if isinstance(noise, Sensor)]
    others = [noise for noise in config.noises if not isinstance(noise, Sensor)]
    places = jnp.array([(others + sensors).index(noise) for noise in config.noises])
    sensor = jax.random.randint(which, (), 0, len(places))

    def by_numbers(key):
        numbers = jax.tree.map(lambda *a: jnp.array(a, jnp.float32), *sensors)
        chosen = jax.tree.map(lambda a: a[jnp.maximum(places[sensor] - len(others), 0)], numbers)
        # Further objects share the material of the others.
        shown = jnp.where(owner < 0, jnp.where(jnp.isfinite(depth), SHELF, owner), owner % BODIES)
        known = jax.tree.map(lambda a: a[:BODIES], world)
        return chosen(key, camera, depth, surfaces_of(scene_key(known), camera, shelf, known, shown, depth))

    models = [lambda key, noise=noise: noise(key, camera, depth) for noise in others] + [by_numbers] * bool(sensors)
    points = jax.lax.switch(jnp.minimum(places[sensor], len(models) - 1), models, sensing)
    labels = true_labels(points, owner, shelf)
    labels = jnp.where((labels == OTHER) & (owner > TARGET), owner, labels)
    seen = Capture(points, labels, object_pixels(owner), alone[:TARGET], sensor)
    return scene, seen


def in_catalogue(world: World) -> Bool[Array, " bodies"]:
    """Which bodies are of the shape and size of one of the paper's eleven objects."""
    bodies = jnp.concatenate([world.kind[:, None].astype(jnp.float32), world.half_size], axis=1)
    return (jnp.abs(bodies[:, None] - jnp.asarray(_CATALOGUE)[None]) < 1e-5).all(axis=-1).any(axis=-1)


def noise_names(config: SceneConfig) -> list[str]:
    """Names of the sensors, as `Capture.sensor` numbers them."""
    sensors: dict[Any, str] = {Sensor(): "none", **{sensor: name for name, sensor in SENSORS.items()}}
    return [sensors.get(noise) or getattr(noise, "__name__", type(noise).__name__) for noise in config.noises]


def visible_share(seen: Capture) -> Float[Array, " objects"]:
    """The share of its pixels that each object shows; 0 if it has none."""
    return jnp.where(seen.alone > 0, seen.pixels / jnp.maximum(seen.alone, 1), 0.0)


def surface_points(
    key: Key[Array, ""], kind: Int[Array, ""], half_size: Float[Array, "3"], count: int
) -> Float[Array, "count 3"]:
    """Uniform random points of the surface of a body, in its own frame [m]."""
    faces, flat, sign = jax.random.split(key, 3)
    area = by_shape(kind, lambda shape: shape.areas(half_size, jnp), jnp)
    face = jax.random.categorical(faces, jnp.log(jnp.maximum(area, 1e-12)), shape=(count,))
    u = jax.random.uniform(flat, (count, 3), minval=-1.0)
    side = jnp.where(jax.random.bernoulli(sign, shape=(count,)), 1.0, -1.0)
    return by_shape(kind, lambda shape: shape.spread(face, u, side, jnp), jnp) * half_size[None]


def worth_seeing(seen: Capture, view: View, pixels: int = PIXELS) -> Bool[Array, " objects"]:
    """Which objects show at least `pixels` pixels of the full image."""
    return seen.pixels * view.stride**2 >= pixels
