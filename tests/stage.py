"""A stage for episodes: two scenes, worlds in which actions do what a test says, and a policy that plans nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.actions import KINDS, Action, ActionKind, no_action
from mechsearch_jax.envs.camera.snapshot import Recogniser, oracle
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.outcome import Failure, Outcome, Overflow
from mechsearch_jax.envs.world.world import BODIES, TARGET, from_scenario
from mechsearch_jax.grasping.retrieval import best_grasp
from mechsearch_jax.planner import Decision, Sequences
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BOX = Body("box", (0.048, 0.028, 0.08), (0.5, 0.135, 0.4845), UPRIGHT)
CYLINDER = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), UPRIGHT)
HIDDEN = Scenario("hidden", (BOX,), CYLINDER)
OPEN = Scenario("open", (dataclasses.replace(BOX, position=(0.6, -0.2, 0.4845)),), CYLINDER)
TWO = Scenario("two", (BOX, dataclasses.replace(BOX, position=(0.6, -0.15, 0.4845))), CYLINDER)
# Low and wide before the target: grasps have to be tilted by more than 20 degrees to reach over it.
SILL = Scenario("sill", (Body("box", (0.01, 0.2, 0.026), (0.52, 0.07, 0.4305), UPRIGHT),), CYLINDER)


def reveal(world):
    """Put the box out of the way."""
    return world.replace(position=world.position.at[0].set(jnp.array([0.6, -0.2, 0.4845])))


def topple(world):
    lying = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return reveal(world).replace(rotation=world.rotation.at[TARGET].set(lying))


def push_off(world):
    """The box stands before the shelf, and no more in front of the target."""
    return world.replace(position=world.position.at[0].set(jnp.array([0.39, -0.2, 0.4845])))


def stays_put(scene):
    """Let the bodies of a scene settle: nothing moves or falls."""
    simulator = NativeWorld()
    before = simulator.reset(scene).position
    outcome = simulator.settle()
    assert outcome.settled
    assert not outcome.fallen.any()
    assert np.abs(np.asarray(simulator.world.position - before)).max() < 1.5e-3


class Stage(Simulator):
    """A simulator in which actions do what a test says: for all worlds, or by the scenario that a world began with.

    A retrieval that is held up has the target in the hand and outside all the same.

    Attributes:
      actions: those that moved an object, one by one.
      executed: for each call the scenarios of the worlds that acted, None for those that did not.
    """

    engine = "Stage"

    def __init__(
        self, acts=None, failures=Failure.NONE, retrievals=Failure.NONE, overflows=Overflow.NONE, restless=False
    ):
        self.world = None
        self.actions, self.executed, self.names = [], [], []
        self._script = {"acts": acts, "failures": failures, "retrievals": retrievals, "overflows": overflows}
        self._script["restless"] = restless

    def _of(self, what, name, default):
        scripted = self._script[what]
        return scripted.get(name, default) if isinstance(scripted, dict) else default if scripted is None else scripted

    def reset(self, scenarios):
        self.names = [None] * len(scenarios)
        self._worlds = [None] * len(scenarios)
        return self.replace(dict(enumerate(scenarios)))

    def replace(self, scenarios):
        for i, scenario in scenarios.items():
            self.names[i], self._worlds[i] = scenario.name, from_scenario(scenario)
        return self._gather()

    def load(self, world, only=None):
        raise AssertionError("an episode begins with scenarios; it never loads a world")

    def settle(self, active=None):
        raise AssertionError("an episode acts; it never just lets time pass")

    def execute(self, actions, active=None):
        count = len(self.names)
        active = np.ones(count, bool) if active is None else active
        self.executed.append([self.names[i] if active[i] else None for i in range(count)])
        outcome = Outcome(
            *(np.zeros(count, np.int32), np.ones(count, np.int32), np.ones(count, bool)),
            *(np.zeros((count, BODIES), bool), np.zeros((count, BODIES), bool)),
            *(np.zeros(count, bool), np.zeros(count, bool), np.zeros(count, bool)),
            *(np.zeros(count, np.int32), np.full(count, 0.001, np.float32)),
        )
        for i in np.flatnonzero(active):
            name = self.names[i]
            outcome.overflow[i] = self._of("overflows", name, Overflow.NONE)
            outcome.settled[i] = not self._of("restless", name, False)
            if KINDS[ActionKind(int(actions.kind[i]))].takes_target:
                outcome.failure[i] = self._of("retrievals", name, Failure.NONE)
                outcome.retrieved[i] = outcome.failure[i] == Failure.NONE
                outcome.held[i] = outcome.outside[i] = outcome.failure[i] in (Failure.NONE, Failure.HELD_UP)
            else:
                self.actions.append(jax.tree.map(lambda a, i=i: a[i], actions))
                outcome.failure[i] = self._of("failures", name, Failure.NONE)
                self._worlds[i] = self._of("acts", name, lambda world: world)(self._worlds[i])
            here = self._worlds[i]
            outcome.fallen[i] = here.valid & (here.position[:, 0] < Shelf().front)
        self._gather()
        return jax.tree.map(jnp.asarray, outcome)

    def _gather(self):
        self.world = jax.tree.map(lambda *leaves: jnp.stack(leaves), *self._worlds)
        return self.world


class Grab(PyTreeNode):
    """A policy: takes the target out as soon as it can be, and else pushes an object, by a random distance.

    Attributes:
      charge: is added to the cost before the target is found.
      nearest: 0 to push the first object, 1 the one that is nearest to the robot, whatever its number. It is data, so
        that both are one program.
      minds: 0 for costs that are all 0, as of a policy that compares none.
    """

    charge: float = 1.0
    nearest: float = 0.0
    minds: float = 1.0

    def __call__(self, key, problem, belief, observation):
        # As the tests of the planner call it, so that it is compiled once.
        grasp = best_grasp(problem.target_grasps, observation.objects, belief.found_pose)
        able = belief.found & grasp.success
        distance = jax.random.uniform(key, minval=0.05, maxval=0.15)
        x = jnp.where(observation.objects.valid, observation.objects.position[:, 0], jnp.inf)
        T = jnp.eye(4).at[:3, 3].set(jnp.array([0.5, 0.0, 0.5]))
        push = Action(
            kind=jnp.int32(ActionKind.PUSH),
            object=jnp.where(self.nearest > 0, jnp.argmin(x), 0).astype(jnp.int32),
            T_world_gripper=T,
            displacement=jnp.array([0.0, 1.0, 0.0]) * distance,
            T_world_place=T.at[1, 3].add(distance),
            q7=jnp.float32(0.7),
            opening=jnp.float32(0.0),
        )
        cost = jnp.where(able, 1.0, jnp.sum(belief.exists) + jnp.where(belief.found, 1.0, self.charge))
        tried = jnp.where(able, jnp.inf, -1.0)[None]
        return Decision(
            action=jax.tree.map(lambda a, b: jnp.where(able, a, b), grasp.action, push),
            value=tried[0],
            cost=self.minds * cost,
            predicted_cost=self.minds * jnp.where(able, jnp.nan, cost - 1.0),
            predicted=observation.objects,
            sequences=Sequences(
                actions=jax.tree.map(lambda a: a[None, None], push),
                cost=cost[None, None] - 1.0,
                value=tried,
                length=jnp.ones(1, jnp.int32),
                after=jax.tree.map(lambda a: a[None], observation.objects),
            ),
        )


grab = Grab()
grab_nearest = Grab(nearest=1.0)


def idle(key, problem, belief, observation):
    """Sees no action that is possible, not even taking the target out."""
    return grab(key, problem, belief, observation).replace(action=no_action())


@dataclasses.dataclass(frozen=True)
class Shuffled:
    """A recogniser that detects the target by itself, and numbers the objects of another in an order of its own.

    Attributes:
      order: the number in `inner` of each object.
      inner: the other recogniser.
    """

    order: tuple[int, ...]
    inner: Recogniser = oracle
    detects_target: bool = True

    def __call__(self, key, snapshot):
        seen = self.inner(key, snapshot)
        objects, confidence = jax.tree.map(lambda a: a[np.array(self.order)], (seen.objects, seen.confidence))
        return seen.replace(objects=objects, confidence=confidence)
