"""A stereo camera on a post: images of a pinhole camera by rays through the model, and what such a sensor makes of it.

Its frame: x to the right of the image, y down, z forward; the first pixel's centre is at 0.5.
"""

import mujoco
import numpy as np

WIDTH, HEIGHT, FOCAL = 848, 480, 617.0
PLACE, AIM = (-0.20, 0.46, 0.60), (0.58, 0.03, 0.47)
BASELINE = 0.05
# Standard deviation of depth at 1 m [m], over how many pixels it is alike, steps of the disparity and missing pixels.
NOISE, ALIKE, DISPARITY_STEP, MISSING = 0.005, 4, 1 / 16, 0.02
LIGHT, AMBIENT = np.array([-0.5, 0.3, 0.81]), 0.45
# Groups of geoms that are seen: things, what stands still, and the robot.
STILL, SHOWN = 1, np.array([1, 1, 1, 0, 0, 0], np.uint8)


def rotation():
    """`R_world_camera`: its columns are the camera's x, y and z."""
    z = np.subtract(AIM, PLACE) / np.linalg.norm(np.subtract(AIM, PLACE))
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _rays(coarse=1):
    u, v = np.meshgrid(np.arange(0.5, WIDTH, coarse), np.arange(0.5, HEIGHT, coarse))
    local = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], axis=-1)
    return local, local @ rotation().T


def cast(world, coarse=1):
    """Geom (h, w), -1 for none, depth along the camera's z (h, w) [m], and normals (h, w, 3) of each pixel's ray."""
    local, rays = _rays(coarse)
    shape, length = rays.shape[:2], np.linalg.norm(local, axis=-1)
    count = shape[0] * shape[1]
    unit = (rays / length[..., None]).reshape(-1)
    geom, distance, normal = np.full(count, -1, np.int32), np.zeros(count), np.zeros(3 * count)
    mujoco.mj_multiRay(
        world.model, world.data, np.array(PLACE), unit, SHOWN, True, -1, geom, distance, normal, count, 10.0
    )
    normal = normal.reshape(-1, 3)
    distance = np.where(geom >= 0, distance, np.inf)
    # mj_multiRay passes through parts of a body of several boxes (MuJoCo 3.17): still boxes are cast here, too.
    for i in np.flatnonzero((world.model.geom_group == STILL) & (world.model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)):
        _cast_box(world.data.geom_xpos[i], world.model.geom_size[i], unit.reshape(-1, 3), i, geom, distance, normal)
    depth = distance.reshape(shape) / length
    return geom.reshape(shape), depth, normal.reshape(*shape, 3)


def _cast_box(centre, half, rays, index, geom, distance, normal):
    """Put a box along the axes into the rays' geoms, distances and normals where it is the nearest."""
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = np.sort(np.stack([(centre - half - PLACE) / rays, (centre + half - PLACE) / rays]), axis=0)
    enter, leave = faces[0].max(axis=1), faces[1].min(axis=1)
    hit = (enter > 0) & (enter <= leave) & (enter < distance)
    axis = faces[0].argmax(axis=1)[hit]
    geom[hit], distance[hit], normal[hit] = index, enter[hit], 0.0
    normal[np.flatnonzero(hit), axis] = -np.sign(rays[hit, axis])


def owners(world, geom):
    """Index of each pixel's thing (the target's is 0), -2 for shelf, -1 for everything else."""
    index = np.array(
        [world.things.index(o) if o in world.things else -2 if o == "shelf" else -1 for o in world.geom_owner] + [-1]
    )
    return index[geom]


def target_pixels(world, coarse=1):
    """How many pixels show the target."""
    return int((owners(world, cast(world, coarse)[0]) == 0).sum())


def look(world, rng):
    """Depth [m], 0 where not measured, colour (uint8) and mask of one image, with fresh noise."""
    geom, depth, normal = cast(world)
    mask = owners(world, geom)
    shade = AMBIENT + (1 - AMBIENT) * np.clip(normal @ LIGHT, 0.0, 1.0)
    paint = np.concatenate([world.model.geom_rgba[:, :3], [[0.7, 0.72, 0.75]]])[geom]
    colour = paint * shade[..., None] + rng.normal(0.0, 0.01, (HEIGHT, WIDTH, 3))
    colour = np.round(255 * np.clip(colour, 0.0, 1.0)).astype(np.uint8)
    measured = measure(depth, rng)
    return measured.astype(np.float32), colour, np.where(measured > 0, mask, -3)


def measure(depth, rng):
    """What a stereo camera makes of true depth [m]: noise, steps, shadows at left edges and holes."""
    depth = np.where(np.isfinite(depth), depth, 100.0)
    coarse = rng.normal(size=(HEIGHT // ALIKE + 2, WIDTH // ALIKE + 2))
    noisy = depth + NOISE * depth**2 * _between(coarse)
    scale = FOCAL * BASELINE
    steps = np.maximum(np.round(scale / noisy / DISPARITY_STEP), 1) * DISPARITY_STEP
    seen_at = np.arange(0.5, WIDTH) - scale / depth
    # The right imager does not see what lies behind the line of sight of a pixel farther to the right.
    least = np.minimum.accumulate(seen_at[:, ::-1], axis=1)[:, ::-1]
    shadow = np.concatenate([seen_at[:, :-1] > least[:, 1:] + 0.5, np.zeros((HEIGHT, 1), bool)], axis=1)
    lost = shadow | (rng.random(depth.shape) < MISSING) | (depth > 10.0)
    return np.where(lost, 0.0, scale / steps)


def _between(coarse):
    """Numbers alike over neighbouring pixels, of unit variance everywhere, from one for each few pixels."""
    weights = []
    for size in (HEIGHT, WIDTH):
        at = (np.arange(size) + 0.5) / ALIKE
        low = at.astype(int)
        w = np.zeros((size, size // ALIKE + 2))
        w[np.arange(size), low], w[np.arange(size), low + 1] = 1 - (at - low), at - low
        weights.append(w / np.linalg.norm(w, axis=1, keepdims=True))
    return weights[0] @ coarse @ weights[1].T
