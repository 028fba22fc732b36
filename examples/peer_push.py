"""What a push in clutter costs a sampling-based controller: judo's MPPI, whose rollouts are MuJoCo's.

    python -m venv judo && judo/bin/pip install judo-rai==0.1.0
    judo/bin/python examples/peer_push.py --rollouts 32 --horizon 1

judo needs another MuJoCo than this project does: this file runs in an environment of its own, and imports nothing of
the project. The scene is the first one of `mechsearch bench plan`, 8 things on a board, of which object 6 is to move by
10 cm, pushed by a finger that slides along x and y, in steps of 4 ms with the settings of our simulator. After each
update what the controller wants is done for 50 ms, as at its usual 20 Hz. Printed are median and spread of an update.
"""

import argparse
import json
import pathlib
import statistics
import tempfile
import time

import judo.tasks.base
import mujoco
import numpy as np
from judo.controller import Controller, ControllerConfig
from judo.optimizers import MPPI, MPPIConfig
from judo.tasks import Task, TaskConfig

# Shape, half-extents [m], x, y [m], yaw [rad]; a cylinder's are radius and half of its height.
THINGS = (
    ("box", (0.054, 0.025, 0.054), 0.492, -0.137, -0.12),
    ("cylinder", (0.032, 0.061), 0.600, 0.187, 0.0),
    ("cylinder", (0.032, 0.067), 0.517, 0.317, 0.0),
    ("cylinder", (0.032, 0.067), 0.687, 0.283, 0.0),
    ("cylinder", (0.032, 0.061), 0.504, -0.047, 0.0),
    ("box", (0.028, 0.048, 0.080), 0.708, -0.002, -0.19),
    ("cylinder", (0.024, 0.067), 0.515, 0.051, 0.0),
    ("box", (0.022, 0.078, 0.096), 0.603, 0.052, -0.32),
)
PUSHED, GOAL = 6, np.array([0.515, 0.151])
# Top of the board and where the finger begins [m]; density [kg/m3] and friction by shape.
BOARD, FINGER = 0.4045, np.array([0.515, 0.005])
MATERIAL = {"box": (737, 0.4), "cylinder": (585, 0.6)}
UPDATE = 0.05

BODY = """<body pos="{x} {y} {z}" euler="0 0 {yaw}"><freejoint/>
  <geom type="{shape}" size="{size}" density="{material[0]}" friction="{material[1]}"/></body>"""
SCENE = """<mujoco>
<compiler angle="radian"/>
<option timestep="0.004" integrator="implicitfast" cone="elliptic" impratio="10" iterations="100" ls_iterations="50"/>
<default><geom condim="4" margin="0.0005"/>
<position kp="1000" kv="60" ctrlrange="-0.3 0.3" forcerange="-30 30"/></default>
<worldbody>
<geom type="plane" size="1 1 0.1" pos="0 0 {board}"/>
<geom type="plane" size="1 1 0.1" pos="0.788 0 0" zaxis="-1 0 0"/>
<geom type="plane" size="1 1 0.1" pos="0 -0.2835 0" zaxis="0 1 0"/>
<geom type="plane" size="1 1 0.1" pos="0 0.4835 0" zaxis="0 -1 0"/>
<body name="finger" pos="{finger[0]} {finger[1]} 0.465" gravcomp="1">
<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<geom type="box" size="0.01 0.01 0.05" mass="0.5" friction="1"/></body>
{things}
</worldbody>
<actuator><position joint="x"/><position joint="y"/></actuator>
</mujoco>"""


def scene():
    """The scene as MJCF."""
    things = ""
    for shape, half, x, y, yaw in THINGS:
        size = " ".join(map(str, half))
        things += BODY.format(shape=shape, size=size, x=x, y=y, z=BOARD + half[-1], yaw=yaw, material=MATERIAL[shape])
    return SCENE.format(board=BOARD, finger=FINGER, things=things)


class Push(Task[TaskConfig]):
    """Object 6 is pushed to its goal, the finger stays behind it, and the others stay where they are."""

    name, config_t = "push", TaskConfig

    def reset(self):
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)

    def reward(self, states, sensors, controls, system_metadata=None):
        finger = FINGER + states[..., :2]
        places = states[..., 2 : self.model.nq].reshape(*states.shape[:-1], len(THINGS), 7)[..., :2]
        start = np.array([thing[2:4] for thing in THINGS])
        start[PUSHED] = GOAL
        off = ((places - start) ** 2).sum(axis=-1)
        near = ((places[..., PUSHED, :] - [0.0, 0.034] - finger) ** 2).sum(axis=-1)
        return -(off.sum(axis=-1) + 0.2 * near).sum(axis=-1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rollouts", type=int, default=32)
    parser.add_argument("--horizon", type=float, default=1.0, help="of a rollout [s]")
    parser.add_argument("--updates", type=int, default=40)
    parser.add_argument("--out", type=pathlib.Path, help="JSON file for the seconds of each update")
    options = parser.parse_args()
    # judo would fetch meshes of its own examples here.
    judo.tasks.base.download_and_extract_meshes = lambda **where: None
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder, "scene.xml")
        file.write_text(scene())
        task = Push(file)
    sampling = MPPIConfig(num_rollouts=options.rollouts, num_nodes=4, sigma=0.05, use_noise_ramp=True, temperature=0.05)
    control = Controller(ControllerConfig(horizon=options.horizon), task, MPPI(sampling, task.nu))
    seconds = []
    # The first two are warming up.
    for _ in range(options.updates + 2):
        control.current_state = np.concatenate([task.data.qpos, task.data.qvel])
        begin = time.perf_counter()
        control.update_action()
        seconds.append(time.perf_counter() - begin)
        for _ in range(round(UPDATE / task.dt)):
            task.data.ctrl[:] = control.action(task.data.time)
            mujoco.mj_step(task.model, task.data)
    ms = [1000 * s for s in seconds[2:]]
    place = task.data.qpos[2 + 7 * PUSHED :][:2]
    off, moved = (100 * np.linalg.norm(place - there) for there in (GOAL, THINGS[PUSHED][2:4]))
    print(
        f"{options.rollouts} rollouts of {options.horizon:g} s: {statistics.median(ms):.0f} ms an update "
        f"({min(ms):.0f} to {max(ms):.0f} in {len(ms)}); object {PUSHED} was moved {moved:.1f} cm, and is {off:.1f} cm "
        "from its goal"
    )
    if options.out is not None:
        options.out.write_text(json.dumps(seconds[2:]))


if __name__ == "__main__":
    main()
