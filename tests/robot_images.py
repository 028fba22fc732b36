"""Images with the robot in them, by MuJoCo's ray-cast of the simulator's model: no display, and none of our own code
for the robot's shape."""

import mujoco
import numpy as np

from mechsearch_jax.envs.camera.simulated_camera import AMBIENT, BACKGROUND_COLOUR, LIGHT, PALETTE, SHELF
from mechsearch_jax.envs.world.model import compile_model, initial_state, with_bodies
from mechsearch_jax.envs.world.world import slots
from mechsearch_jax.workspace.camera import rays

ROBOT = SHELF + 1
ROBOT_COLOUR = (0.93, 0.93, 0.95)


def robot_image(camera, shelf, scenario, joints, opening):
    """Depth, colour and owner of every pixel; the owner is a slot, the shelf's, `ROBOT`, or -1."""
    bodies = slots(scenario)
    model = with_bodies(compile_model(shelf, camera), bodies, skin=0.0)
    data = initial_state(model, bodies)
    for i, angle in enumerate(joints):
        data.joint(f"joint{i + 1}").qpos[0] = angle
    for side in ("left", "right"):
        data.joint(f"{side}_finger").qpos[0] = opening / 2
    mujoco.mj_forward(model, data)

    directions = np.asarray(rays(camera), float).reshape(-1, 3)
    length = np.linalg.norm(directions, axis=1)
    unit = directions / length[:, None]
    geom, distance = np.full(len(unit), -1, np.int32), np.zeros(len(unit))
    normal = np.zeros(3 * len(unit))
    # Robot, boards and bodies; not the infinite planes that stand for the boards in contacts.
    groups = np.array([1, 1, 0, 1, 0, 0], np.uint8)
    mujoco.mj_multiRay(
        model, data, np.array(camera.position), unit.ravel(), groups, 1, -1, geom, distance, normal, len(unit), 10.0
    )
    names = [model.geom(g).name for g in range(model.ngeom)]

    def owner_of(name):
        if name.startswith(("box", "cylinder")):
            return int(name.removeprefix("box").removeprefix("cylinder"))
        return SHELF if name.endswith("_box") else ROBOT

    owners = np.array([*map(owner_of, names), -1])[geom]
    depth = np.where(geom >= 0, distance / length, np.inf).astype(np.float32)
    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    shade = AMBIENT + (1 - AMBIENT) * np.maximum(normal.reshape(-1, 3) @ light, 0)
    colour = np.concatenate([PALETTE, [ROBOT_COLOUR, BACKGROUND_COLOUR]])[owners] * shade[:, None]
    colour[owners < 0] = BACKGROUND_COLOUR
    shape = (camera.height, camera.width)
    return depth.reshape(shape), colour.reshape(*shape, 3).astype(np.float32), owners.reshape(shape)
