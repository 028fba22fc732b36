"""Whether the controller of a Panda or an FR3 accepts a trajectory file, from the maker's public figures alone.

Panda: "Robot and interface specifications" of the FCI documentation. FR3: the same page's limits of the Research 3,
whose speeds depend on the position (libfranka, rate_limiting.h). The controller is sent a position each millisecond;
between the rows of a file they are those of the cubic through positions and velocities, as ROS's trajectory controller
has them.
"""

from pathlib import Path

import numpy as np

PERIOD = 1e-3
# A controller that is commanded from elsewhere than where the arm is jumps: largest gap at the start [rad].
START = 5e-3
# What rounding of a file's nine digits and of differences over a millisecond amounts to, as a share.
ROUNDING = 0.005

PANDA = {
    "least": [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
    "most": [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
    "velocity": [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
    "acceleration": [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
    "jerk": [7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0],
}
FR3 = {
    "least": [-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159],
    "most": [2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159],
    "velocity": [2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26],
    "acceleration": [10.0] * 7,
    "jerk": [5000.0] * 7,
    # Of the speed towards an end: sqrt(rate * distance to the end) - offset.
    "offset": [0.3, 0.2, 0.2, 0.3, 0.35, 0.35, 0.35],
    "rate": [12.0, 5.17, 7.0, 8.0, 34.0, 11.0, 34.0],
    "upper_end": [2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196],
    "lower_end": [-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196],
}
ARMS = {"panda": PANDA, "fr3": FR3}


def read_csv(path):
    """Time (T,), joint positions and velocities (T, 7), width and force (T,) of a trajectory file, by its header."""
    with Path(path).open() as file:
        names = [name.split()[0].split("[")[0] for name in file.readline().strip().split(",")]
    table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    columns = {name: table[:, i] for i, name in enumerate(names)}
    q, v = (np.stack([columns[f"{letter}{i}"] for i in range(1, 8)], axis=1) for letter in "qv")
    return columns["time"], q, v, columns["width"], columns["force"]


def each_millisecond(time, q, v):
    """Times (N,), positions and velocities (N, 7) of the cubic through rows of a file, a millisecond apart."""
    at = np.arange(0.0, time[-1] + PERIOD / 2, PERIOD)
    row = np.clip(np.searchsorted(time, at, side="right") - 1, 0, max(len(time) - 2, 0))
    step = (time[row + 1] - time[row])[:, None]
    s = (at - time[row])[:, None] / step
    p0, p1, m0, m1 = q[row], q[row + 1], v[row] * step, v[row + 1] * step
    a, b = 2 * (p0 - p1) + m0 + m1, 3 * (p1 - p0) - 2 * m0 - m1
    return at, ((a * s + b) * s + m0) * s + p0, ((3 * a * s + 2 * b) * s + m0) / step


def faults(path, arm, joints):
    """What the controller of `arm` would refuse of a file with the arm at `joints` [rad]; also the largest shares."""
    time, q, v, *_ = read_csv(path)
    limit = {name: np.array(values) for name, values in ARMS[arm].items()}
    found = []
    if not (np.diff(time) > 0).all() or time[0] != 0.0:
        return ["times do not ascend from 0"], {}
    gap = np.abs(q[0] - joints).max()
    if gap > START:
        found.append(f"begins {gap:.4f} rad from the measured joints")
    _, q, _ = each_millisecond(time, q, v)
    if (q < limit["least"]).any() or (q > limit["most"]).any():
        joint = int(np.argmax(np.maximum(limit["least"] - q, q - limit["most"]).max(axis=0)))
        found.append(f"joint {joint + 1} leaves its range")
    # At rest before and afterwards.
    q = np.concatenate([np.repeat(q[:1], 3, axis=0), q, np.repeat(q[-1:], 3, axis=0)])
    rates = [np.diff(q, n=n, axis=0) / PERIOD**n for n in (1, 2, 3)]
    upper = lower = np.broadcast_to(limit["velocity"], rates[0].shape)
    if "rate" in limit:
        for towards, end in (("upper", limit["upper_end"] - q[:-1]), ("lower", q[:-1] - limit["lower_end"])):
            slowed = np.sqrt(np.maximum(limit["rate"] * end, 0.0)) - limit["offset"]
            slowed = np.minimum(limit["velocity"], np.maximum(slowed, 1e-3))
            upper, lower = (slowed, lower) if towards == "upper" else (upper, slowed)
    shares = {
        "velocity": np.maximum(rates[0] / upper, -rates[0] / lower),
        "acceleration": np.abs(rates[1]) / limit["acceleration"],
        "jerk": np.abs(rates[2]) / limit["jerk"],
    }
    for name, share in shares.items():
        row, joint = np.unravel_index(np.argmax(share), share.shape)
        if share[row, joint] > 1.0 + ROUNDING:
            found.append(f"{name} of joint {joint + 1} is {share[row, joint]:.2f} of its limit at {row * PERIOD:.2f} s")
    return found, {name: round(float(share.max()), 3) for name, share in shares.items()}
