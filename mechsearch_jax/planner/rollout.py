"""The engine: sampling-based model predictive control over predicted states (paper sections 3 and 4.4, appendix B.4).

Sequences of actions are sampled from the predicted state of each step, all of them in one vmapped computation, and the
first action of the best is taken. What is sampled, what it changes and what is to be made small are slots.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.candidates import AllCandidates, all_candidates, no_candidates
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.sampler import contact_probability
from mechsearch_jax.actions.types import Action, Prediction, Sample
from mechsearch_jax.belief.belief import Belief, possible_space, with_target
from mechsearch_jax.belief.moved_target import candidate_of
from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.existence import existence, no_views, object_views
from mechsearch_jax.geometry.masked import on_cpu
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.graspability import grasp_hits, no_hits, pairs, split_found
from mechsearch_jax.planner.objective import Objective
from mechsearch_jax.planner.prediction import Predict
from mechsearch_jax.planner.proposal import DrawnIn, Propose, as_predicted
from mechsearch_jax.planner.state import Decision, Sequences, State
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.retrieval import found_hits

# A sequence whose value is a smaller share of J gains nothing.
GAIN = 0.02
# Draws an action in a state, and predicts it: one of several.
Attempt = Callable[[State, Array], tuple[Sample, Prediction]]
# What an action changes in a state, and what is then computed for the next one.
CHANGING = ("scene", "target_at", "moved", "available", "alive", "candidates")


def prefix_values(
    cost: Float[Array, " n"], penalty: Float[Array, " m"], acted: Bool[Array, " m"], gamma: Array | float
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Equation 2 for every prefix of a sequence, with the penalties of its actions: the best value, and its length.

    `cost` is J before each action and after the last.
    """
    discount = gamma ** jnp.arange(penalty.shape[0], dtype=jnp.float32)
    values = jnp.where(acted, jnp.cumsum(discount * (jnp.diff(cost) + penalty)), jnp.inf)
    return jnp.min(values), jnp.argmin(values) + 1


def sequence_values(
    cost: Float[Array, "s n"], penalty: Float[Array, "s m"], acted: Bool[Array, "s m"], gamma: Array | float
) -> tuple[Float[Array, " s"], Int[Array, " s"]]:
    """`prefix_values` of all sequences, which begin in the same state.

    Where none of them gains anything, there are no penalties: what is risky is done rather than nothing.
    """
    values = jax.vmap(functools.partial(prefix_values, gamma=gamma))
    penalised, free = values(cost, penalty, acted), values(cost, jnp.zeros_like(penalty), acted)
    stuck = jnp.min(penalised[0]) > -GAIN * cost[0, 0]
    return jax.tree.map(functools.partial(jnp.where, stuck), free, penalised)


def present_state(problem: Problem, belief: Belief, objects: Superquadrics, config: PlannerConfig) -> State:
    """The state in which sequences begin, of which nothing is computed yet: as if every object had just moved.

    Args:
      problem, belief: what does not change, and what is known.
      objects: as recognised, fields (N, ...).
      config: how the planner decides.
    """
    scene, is_target = with_target(problem, belief, objects)
    count, spread = problem.existence.T_world_target.shape[:2]
    places = (count, spread) if config.predicted_collisions else None
    return State(
        scene=scene,
        is_target=is_target,
        exists=belief.exists,
        target_at=jnp.zeros_like(belief.exists),
        views=no_views(scene.capacity, problem.config.existence, places),
        hits=no_hits(pairs(problem.grasps, belief.grasps.feasible), scene.capacity),
        candidates=no_candidates(problem.space, scene.capacity),
        moved=scene.valid,
        available=scene.valid & (~is_target | config.move_target),
        alive=jnp.array(True),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """What all states of a decision share, and how one leads to the next.

    Attributes:
      problem, belief: what does not change, and what is known.
      config: how the planner decides.
      propose, predict, objective, drawn_in: the slots.
      present: the scene in which sequences begin; None outside of them.
    """

    problem: Problem
    belief: Belief
    config: PlannerConfig
    propose: Propose
    predict: Predict
    objective: Objective
    drawn_in: DrawnIn = as_predicted
    present: Superquadrics | None = None

    def root(self, objects: Superquadrics) -> State:
        """`present_state` with what the rollout knows."""
        return present_state(self.problem, self.belief, objects, self.config)

    def update(self, state: State, moved: Bool[Array, " n"]) -> State:
        """Bring f and g of a state up to date after some objects moved."""
        problem, settings = self.problem, self.problem.config.existence
        objects = state.scene.replace(valid=state.scene.valid & ~state.is_target)
        counts_collisions = state.exists if self.config.predicted_collisions else None
        views = object_views(
            problem.existence, problem.camera, objects, counts_collisions, settings, state.views, moved
        )
        here = jnp.where(self.belief.found, state.target_at, state.exists)
        exists = existence(problem.existence, problem.camera, views, here, self.belief.allowed, settings)
        of_candidates, of_found = split_found(
            self.objective.needs_graspability(self.belief, state.replace(exists=exists))
        )
        grasps, rows = self.belief.grasps, problem.grasps.pair_pose.shape[0]
        # Where the target has moved, other rows of H count, of which nothing is known yet.
        unknown = moved | jnp.any(moved & state.is_target)
        hits = grasp_hits(problem.grasps, objects, of_candidates, state.hits[:rows], unknown)
        more = found_hits(problem.target_grasps, grasps, objects, of_found, state.hits[rows:], moved)
        return state.replace(exists=exists, views=views, hits=jnp.concatenate([hits, more]))

    def candidates(self, state: State, moved: Bool[Array, " n"]) -> AllCandidates:
        """Candidate actions where an action of a state is drawn, brought up to date after some objects moved."""
        possible = possible_space(self.problem, self.belief, state.exists)
        scene = self.drawn_in(self.present, state).scene
        return all_candidates(self.problem.space, scene, possible, state.candidates, moved, state.able)

    def cost(self, state: State) -> Float[Array, ""]:
        """J of a state that is up to date."""
        return self.objective.cost(self.problem, self.belief, state, self.config.weights)

    def _attempt(self, first: Bool[Array, ""], state: State, key: Array) -> tuple[Sample, Prediction]:
        drawn_in = self.drawn_in(self.present, state)
        sample = self.propose(key, self.problem, self.belief, self.objective, self.config.guided_fraction, drawn_in)
        return sample, self.predict(self.problem, state, sample, first)

    def _draw(self, first: Bool[Array, ""], state: State, key: Array) -> tuple[Sample, Prediction]:
        """An action and what it does; drawn again until it is possible, at most so often as `config` says."""
        most = max(self.config.draws, self.config.first_draws)
        if most == 1:
            return self._attempt(first, state, key)
        draws = jnp.where(first, most, self.config.draws)
        attempt = lambda state, i: self._attempt(first, state, jax.random.fold_in(key, i))  # noqa: E731
        return (_one_after_the_other if on_cpu() else _at_once)(attempt, state, draws, most)

    def act(self, first: Bool[Array, ""], state: State, key: Array) -> tuple[dict[str, Any], Action, Array]:
        """Sample an action and predict what it changes in a state; also its penalty, as a share of J."""
        sample, prediction = self._draw(first, state, key)
        acted = prediction.possible & state.alive
        action = sample.action.replace(kind=jnp.where(acted, sample.action.kind, ActionKind.NONE).astype(jnp.int32))
        spent = (jnp.arange(state.scene.capacity) == action.object) & (not self.config.move_again)
        moved = prediction.moved & acted
        target_at = state.target_at
        if self.config.move_target:
            at = candidate_of(self.problem, prediction.scene, state.is_target)
            target_at = jnp.where(jnp.any(moved & state.is_target), at, target_at)
        changes = {
            "scene": prediction.scene,
            "target_at": target_at,
            "moved": moved,
            "available": state.available & ~spent,
            "alive": acted,
        }
        return changes, action, self.config.unseen_contact_penalty * self.contact_probability(state, sample)

    def contact_probability(self, state: State, sample: Sample) -> Float[Array, ""]:
        """Share of the possible poses at which an action would touch the target, where it was drawn."""
        possible = possible_space(self.problem, self.belief, state.exists)
        scene = self.drawn_in(self.present, state).scene
        return contact_probability(self.problem.space, scene, possible, sample)

    def step(self, states: State, keys: Array, time: Int[Array, ""]):
        """All sequences by one action: the states after it, and what is to be kept of the ones before it."""
        count = self.config.sequences
        # All sequences begin in the same state, so only the first computes it.
        first = time == 0
        computes = (~first | (jnp.arange(count) == 0))[:, None]
        moved = states.moved & computes
        shared = lambda tree: jax.tree.map(lambda a: jnp.where(first, a[:1], a), tree)  # noqa: E731
        states = shared(jax.vmap(self.update)(states.replace(exists=states.exists & computes), moved))

        def go_on():
            candidates = shared(jax.vmap(self.candidates)(states, moved))
            act = jax.vmap(functools.partial(self.act, first))
            changes, actions, penalty = act(states.replace(candidates=candidates), keys)
            return changes | {"candidates": candidates}, actions, penalty

        def stay():
            changes = {name: getattr(states, name) for name in CHANGING}
            return changes, repeated(no_action(), count), jnp.zeros(count)

        # After the last action only the cost counts. What the actions do not change does not pass through the branches.
        changes, actions, penalty = jax.lax.cond(time < self.config.horizon, go_on, stay)
        kept = (actions, jax.vmap(self.cost)(states), penalty, changes["scene"])
        return states.replace(**changes), kept


def _to_do_in(state: State, counts: Bool[Array, ""]) -> State:
    """The state for an attempt, which finds no object and nothing that can be moved if it does not count.

    So it has little to do, and nothing to simulate.
    """
    scene = state.scene.replace(valid=state.scene.valid & counts)
    return state.replace(scene=scene, available=state.available & counts)


def _one_after_the_other(attempt: Attempt, state: State, draws: Int[Array, ""], most: int) -> tuple[Sample, Prediction]:
    """The first attempt that is possible, and no more of them than it takes: for a CPU, which has enough to do."""
    shapes, _ = jax.eval_shape(attempt, state, jnp.int32(0))
    nothing = Prediction(state.scene, jnp.zeros_like(state.moved), jnp.array(False))
    blank = (jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), nothing)

    def again(carry):
        i, (_, prediction) = carry
        # In a batch, those that have an action go round with the others.
        return i + 1, attempt(_to_do_in(state, state.alive & ~prediction.possible), i)

    def wanted(carry):
        i, (_, prediction) = carry
        return (i < draws) & ~prediction.possible & state.alive

    return jax.lax.while_loop(wanted, again, (jnp.int32(0), blank))[1]


def _at_once(attempt: Attempt, state: State, draws: Int[Array, ""], most: int) -> tuple[Sample, Prediction]:
    """The first attempt that is possible, of all of them: for a GPU, on which waiting for the first takes longer."""
    number = jnp.arange(most, dtype=jnp.int32)

    sample, prediction = jax.vmap(lambda i: attempt(_to_do_in(state, state.alive & (i < draws)), i))(number)
    works = prediction.possible & (number < draws)
    sample, prediction = jax.tree.map(lambda a: a[jnp.argmax(works)], (sample, prediction))
    return sample, prediction.replace(possible=jnp.any(works))


def repeated(tree: Any, count: int) -> Any:
    """A pytree with a leading axis of so many equal rows."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), tree)


def plan(rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
    """Decide on the next action by sampling sequences and keeping the first action of the best (B.4).

    Args:
      rollout: what is known, and how states lead to states.
      key: PRNG key of the planner.
      objects: as recognised, fields (N, ...).

    Returns:
      The decision and everything that was considered. The same arguments give the same decision, also under `vmap`.
    """
    config = rollout.config
    count, horizon = config.sequences, config.horizon
    root = rollout.root(objects)
    rollout = dataclasses.replace(rollout, present=root.scene)
    states = repeated(root, count)
    keys = jnp.swapaxes(jax.vmap(lambda k: jax.random.split(k, horizon + 1))(jax.random.split(key, count)), 0, 1)
    _, (actions, cost, penalty, scenes) = jax.lax.scan(
        lambda states, now: rollout.step(states, *now), states, (keys, jnp.arange(horizon + 1))
    )
    actions, penalty = jax.tree.map(lambda a: jnp.swapaxes(a[:-1], 0, 1), (actions, penalty))
    cost, now = jnp.swapaxes(cost, 0, 1), cost[0, 0]
    value, length = sequence_values(cost, penalty * cost[:, :-1], actions.kind != ActionKind.NONE, config.gamma)
    # Without the target's slot, which comes after those of the objects.
    after = jax.tree.map(lambda a: a[0, :, : objects.capacity], scenes)
    sequences = Sequences(actions, cost[:, 1:], value, length, after)
    order = jnp.argsort(sequences.value, stable=True)
    sequences = jax.tree.map(lambda a: a[order], sequences)
    return Decision(
        action=jax.tree.map(lambda a: a[0, 0], sequences.actions),
        value=sequences.value[0],
        cost=now,
        predicted_cost=sequences.cost[0, 0],
        predicted=jax.tree.map(lambda a: a[0], sequences.after),
        sequences=sequences,
        refused=jnp.int32(0),
    )


def no_sequences(config: PlannerConfig, objects: Superquadrics) -> Sequences:
    """What there is where nothing was sampled, and the objects are as they are."""
    count, horizon = config.sequences, config.horizon
    return Sequences(
        actions=repeated(repeated(no_action(), horizon), count),
        cost=jnp.full((count, horizon), jnp.nan),
        value=jnp.full(count, jnp.inf),
        length=jnp.ones(count, jnp.int32),
        after=repeated(objects, count),
    )
