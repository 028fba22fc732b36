"""A trajectory executed by servos in physics: what was touched and how hard, what the hand holds, and what moved."""

import collections
import dataclasses
import math

import mujoco
import numpy as np

from .limits import PERIOD, each_millisecond
from .world import BOARD, DAMPING, FRONT, GAINS, STAND, STEP

FINGERS = ("left finger", "right finger")
PULL = ("all", "hand")
# Forces are means over so many steps, 10 ms: an impact's single peak depends on the contact's stiffness.
WINDOW = 5
# In how many steps it is noted once what the hand holds, and how long the arm waits for a hand that still moves [s].
EVERY, PATIENCE = 10, 3.0
# A finger: stiffness [N/m], damping [N s/m]; force of a move without a grip [N]; rest [m/s]; a move's tolerance [m].
STIFF, DAMP, MOVING_FORCE, REST, REACHED = 4000.0, 80.0, 30.0, 2e-3, 2.5e-3
SETTLE = 0.6
# With less force than this at a point, what is held only stands on the board or its stand [N].
WEIGHT = 5.0
# What it is pressed on from above with more.
SUPPORTS = ("shelf below", "stand below")
# A thing that is let go so far above what is below it is dropped [m].
DROP = 0.02


@dataclasses.dataclass
class Hand:
    """What the hand is about: fingers move to `width` at `speed` with at most `force`; a grip's width is below 0."""

    width: float = 0.08
    speed: float = 0.1
    force: float = MOVING_FORCE
    wanted: float = 0.08

    def begin(self, event, width):
        """Begin an event with the fingers `width` apart."""
        grasp = event.kind == "grasp"
        self.wanted, self.speed = width, event.speed
        self.width, self.force = (-0.06, event.force) if grasp else (event.width, MOVING_FORCE)

    def forces(self, data):
        """Of both fingers' motors [N]; to be called in each step."""
        step = self.speed * STEP
        self.wanted += float(np.clip(self.width - self.wanted, -step, step))
        return np.clip(STIFF * (self.wanted / 2 - data.qpos[7:9]) - DAMP * data.qvel[7:9], -self.force, self.force)


@dataclasses.dataclass
class Executed:
    """What came of a motion.

    Attributes:
      ok: whether arm and hand did all that they were to do.
      stopped: whether the controller stopped the arm.
      notes: what went wrong, a line each.
      forces: the largest force between two bodies [N], of the robot or what it holds.
      gaps: largest deviation of a joint from its path [rad].
      grasps: of each grasp what width was expected, what was measured [m], and what was between the fingers.
      held: what is between the fingers at the end.
      lifted: what was lifted; dropped: what fell out of the hand, and whether the hand opened or it slipped.
      moved: how far [m] and by how much [degrees] things turned that were moved.
    """

    ok: bool = True
    stopped: bool = False
    notes: list = dataclasses.field(default_factory=list)
    forces: dict = dataclasses.field(default_factory=dict)
    gap: float = 0.0
    grasps: list = dataclasses.field(default_factory=list)
    held: list = dataclasses.field(default_factory=list)
    lifted: list = dataclasses.field(default_factory=list)
    dropped: dict = dataclasses.field(default_factory=dict)
    moved: dict = dataclasses.field(default_factory=dict)


class _Watch:
    """Contacts and held things while physics goes on."""

    def __init__(self, world, hand, result):
        self.world, self.hand, self.result = world, hand, result
        # Of each pair of bodies, and of the hand with its fingers, the forces of the last steps and their sum.
        self.recent = collections.defaultdict(lambda: (collections.deque([np.zeros(3)] * WINDOW), np.zeros(3)))
        self.foot = {name: pose[0][2] for name, pose in world.poses().items()}
        self.count, self.pull = 0, 0.0
        self._hold(held_things(world))

    def _hold(self, held):
        self.held = held
        self.watched = self.world.robot_geom | np.isin(self.world.geom_owner, sorted(held))

    def step(self):
        """Advance physics by a step, and note what touches what."""
        world, data = self.world, self.world.data
        data.ctrl[7:9] = self.hand.forces(data)
        mujoco.mj_step(world.model, data)
        now = self._forces()
        for pair in self.recent.keys() | now.keys():
            kept, total = self.recent[pair]
            force = now.get(pair, np.zeros(3))
            total += force - kept.popleft()
            kept.append(force)
            size = float(np.linalg.norm(total)) / WINDOW
            if pair == PULL:
                self.pull = size
            else:
                self.result.forces[pair] = max(self.result.forces.get(pair, 0.0), size)
        for pair in [
            pair for pair in self.recent if pair not in now and not any(f.any() for f in self.recent[pair][0])
        ]:
            del self.recent[pair]
            self.pull = 0.0 if pair == PULL else self.pull
        self.count += 1
        if self.count % EVERY == 0:
            self._note_held()

    def _forces(self):
        """Force on the robot, or on what it holds, of each pair of bodies at present, and on the hand [N]."""
        world, data, found = self.world, self.world.data, {}
        geoms = data.contact.geom
        for i in np.flatnonzero(self.watched[geoms].any(axis=1)) if len(geoms) else ():
            one, two = geoms[i]
            a, b, robot = world.owner[one], world.owner[two], (world.robot_geom[one], world.robot_geom[two])
            local = np.zeros(6)
            mujoco.mj_contactForce(world.model, data, i, local)
            force = data.contact.frame[i].reshape(3, 3).T @ local[:3]
            # MuJoCo's force is the second geom's.
            if robot[0] or (not any(robot) and a in self.held):
                a, b, force = b, a, -force
            if not any(robot) and a in ("shelf", "stand") and force[2] > 0.7 * np.linalg.norm(force):
                if force[2] < WEIGHT:
                    continue  # what is held stands on something, too
                # Pressed on it by what grasps or pushes it, or set down.
                a = f"{a} below"
            pairs = [(b if any(robot) else f"{b} (held)", a)]
            if any(robot) and b != "arm":
                pairs.append(PULL)
            for pair in pairs:
                found[pair] = found.get(pair, 0.0) + force
        return found

    def _note_held(self):
        now, poses = held_things(self.world), self.world.poses()
        for name in now:
            if poses[name][0][2] > self.foot[name] + 0.01 and name not in self.result.lifted:
                self.result.lifted.append(name)
        for name in self.held - now:
            drop = height_above(self.world, name)
            if drop > DROP and name not in self.result.dropped:
                why = "the hand opened" if self.hand.width > 0 else "it slipped"
                self.result.dropped[name] = f"{why}, {100 * drop:.0f} cm above what is below"
        for name in now:
            if self.result.dropped.get(name, "").startswith("it slipped"):
                del self.result.dropped[name]  # it only shifted between the fingers
        self._hold(now)


def held_things(world):
    """Names of things that touch both fingers."""
    touching = {finger: set() for finger in FINGERS}
    for one, two in world.data.contact.geom:
        for a, b in ((one, two), (two, one)):
            if world.geom_owner[a] in touching:
                touching[str(world.geom_owner[a])].add(str(world.geom_owner[b]))
    return set.intersection(*touching.values()) & set(world.things)


def height_above(world, name):
    """How far the lowest point of a thing is above board, stand or floor [m], whichever is below its middle."""
    body = world.model.body(name).id
    low = math.inf
    for i in np.flatnonzero(world.model.geom_bodyid == body):
        up, size = world.data.geom_xmat[i].reshape(3, 3)[2], world.model.geom_size[i]
        if world.model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX:
            extent = np.abs(up) @ size
        else:
            extent = abs(up[2]) * size[1] + math.hypot(*up[:2]) * size[0]
        low = min(low, world.data.geom_xpos[i][2] - extent)
    x, y, _ = world.data.xpos[body]
    on_stand = max(abs(x - STAND[0]), abs(y - STAND[1])) < 0.09
    return low - (STAND[2] if on_stand else BOARD if x > FRONT else 0.0)


def rest(world, hand, seconds):
    """Let physics go on with the arm held where it is."""
    watch, q = _Watch(world, hand, Executed()), world.joints
    for _ in range(int(seconds / STEP)):
        world.data.ctrl[:7] = q
        watch.step()


def follow(world, hand, rows, events, tracking, force):
    """Execute a trajectory as a controller and a Franka Hand would.

    Where a waiting event is not over in time, the arm waits on. If a move of the hand on the way to the shelf fails,
    the arm goes the same way back; after a failed grasp it goes on, for that is its way out.

    Args:
      world, hand: the cell.
      rows: time (T,), joint positions and velocities (T, 7).
      events: of the hand, with kind, start, duration, waits, width, speed and of grasps force, inner and outer.
      tracking, force: deviation of a joint [rad] and force on the hand [N] at which the controller stops.
    """
    result = Executed()
    watch, before = _Watch(world, hand, result), world.poses()
    _, q, v = (values[:: round(STEP / PERIOD)] for values in each_millisecond(*rows))
    lead = np.array(DAMPING) / np.array(GAINS)
    begun, ended = set(), set()
    at, direction, waited = 0, 1, 0
    while 0 <= at < len(q):
        seconds = at * STEP
        for i, event in enumerate(events):
            if direction == 1 and i not in begun and seconds >= event.start:
                begun.add(i)
                hand.begin(event, world.width)
            if direction == 1 and i in begun - ended and seconds >= event.start + event.duration:
                still = np.abs(world.data.qvel[7:9]).max() < REST
                if not still and waited < PATIENCE / STEP:
                    waited += 1
                    break
                ended.add(i)
                waited = 0
                done = _event_done(world, event, result)
                result.ok = result.ok and bool(done)
                if not done and event.kind == "move" and not event.waits:
                    direction = -1
        else:
            waited = 0
        paused = waited > 0
        world.data.ctrl[:7] = q[at] + (0.0 if paused else direction * lead * v[at])
        watch.step()
        gap = float(np.abs(world.data.qpos[:7] - q[at]).max())
        result.gap = max(result.gap, gap)
        if gap > tracking or watch.pull > force:
            what = f"a joint is {gap:.3f} rad off its path" if gap > tracking else f"{watch.pull:.0f} N on the hand"
            result.notes.append(f"the controller stopped the arm at {seconds:.2f} s: {what}")
            result.ok, result.stopped = False, True
            break
        at += 0 if paused else direction
    hold = world.joints if result.stopped else q[min(max(at, 0), len(q) - 1)]
    for _ in range(int(SETTLE / STEP)):
        world.data.ctrl[:7] = hold
        watch.step()
    after = world.poses()
    for name, (place, turned) in after.items():
        shift = float(np.linalg.norm(place - before[name][0]))
        tilt = math.degrees(math.acos(np.clip(before[name][1][:, 2] @ turned[:, 2], -1, 1)))
        if shift > 0.003 or tilt > 3.0:
            result.moved[name] = [round(shift, 4), round(tilt, 1)]
    result.held = sorted(held_things(world))
    return result


def _event_done(world, event, result):
    width = world.width
    if event.kind == "move":
        done = abs(width - event.width) < REACHED
        if not done:
            result.notes.append(f"the hand did not move to {1000 * event.width:.0f} mm, but {1000 * width:.0f}")
        return done
    between = sorted(held_things(world))
    done = event.width - event.inner <= width <= event.width + event.outer
    result.grasps.append(
        {
            "expected": round(event.width, 4),
            "inner": round(event.inner, 4),
            "outer": round(event.outer, 4),
            "measured": round(width, 4),
            "between": between,
        }
    )
    if not done:
        result.notes.append(
            f"the grasp failed by its width: {1000 * width:.0f} mm where {1000 * event.width:.0f} were expected, with "
            f"{' and '.join(between) or 'nothing'} between the fingers"
        )
    return done
