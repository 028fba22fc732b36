#!/usr/bin/env bash
# MuJoCo's mj_multiRay passes through boards of a shelf that mj_ray hits, where they are one body and the eye is outside.
#
# mujoco 3.17.0 (pip, Linux, Python 3.11). mj_multiRay has "similar semantics to mj_ray" (API reference), for many rays
# from one point. The body is five boxes that stand as a shelf does, nothing else is in the model, and the rays are a
# camera's, 75 degrees wide. Expected: the same geom for each ray. Output of this script:
#   eye in front: 0 of 8362 hits lost; eye above and to the side: 125 of 2867 hits lost
# The same boxes in the world's body, or each in a body of its own, lose none. Whoever renders depth images with
# mj_multiRay sees through corners of furniture; one call of mj_ray for each pixel does not.
#
# Exits with 1 if that has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.17.0 numpy==2.3.5
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mujoco
import numpy as np

BOARDS = [
    ("0.4 0.35 0.01", "0.6 0 -0.2"),
    ("0.4 0.35 0.01", "0.6 0 0.2"),
    ("0.4 0.01 0.2", "0.6 0.35 0"),
    ("0.4 0.01 0.2", "0.6 -0.35 0"),
    ("0.01 0.35 0.2", "1.0 0 0"),
]
geoms = "".join(f'<geom type="box" size="{size}" pos="{place}"/>' for size, place in BOARDS)
model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body>{geoms}</body></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)


def lost(eye, count=97):
    eye = np.array(eye)
    forward = np.array([0.7, 0.0, -0.05]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    across = np.tan(np.radians(75 / 2)) * (2 * (np.arange(count) + 0.5) / count - 1)
    rays = forward + across[None, :, None] * right + across[:, None, None] * np.cross(forward, right)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    geom, distance, one = np.full(len(rays), -1, np.int32), np.zeros(len(rays)), np.zeros(1, np.int32)
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), None, 1, -1, geom, distance, None, len(rays), 10.0)
    single = []
    for ray in rays:
        mujoco.mj_ray(model, data, eye, ray, None, 1, -1, one, None)
        single.append(int(one[0]))
    hits = np.array(single) >= 0
    return int((hits & (geom != np.array(single))).sum()), int(hits.sum())


before, above = lost((-0.1, 0.1, 0.05)), lost((-0.3, 0.2, 0.5))
print(f"eye in front: {before[0]} of {before[1]} hits lost; eye above and to the side: {above[0]} of {above[1]} hits lost")
sys.exit((before, above) != ((0, 8362), (125, 2867)))
PYTHON
