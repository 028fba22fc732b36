"""The engine: sampling-based model predictive control over predicted states (paper sections 3 and 4.4, appendix B.4).

All sequences of actions are sampled in one vmapped computation, each action in the predicted state of its step, and the
first action of the best sequence is taken. Sampling, prediction and the cost are slots.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.candidates import AllCandidates, all_candidates, contact_probability, no_candidates
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.types import Action, Prediction, Sample
from mechsearch_jax.belief.belief import Belief, possible_space, with_target
from mechsearch_jax.belief.moved_target import candidate_of
from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.existence import existence, no_views, object_views
from mechsearch_jax.geometry.masked import on_cpu
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.grasping.graspability import grasp_hits, no_hits, pairs, split_found
from mechsearch_jax.grasping.retrieval import found_hits
from mechsearch_jax.planner.objective import Objective
from mechsearch_jax.planner.prediction import Predict
from mechsearch_jax.planner.proposal import Propose
from mechsearch_jax.planner.state import Decision, Sequences, State
from mechsearch_jax.problem.problem import Problem

# Least decrease of J, as a share of J, that counts as a gain.
GAIN = 0.02
# Draws an action and predicts it, given the number of the draw and whether it counts.
Attempt = Callable[[Array, Array], tuple[Sample, Prediction]]
# Fields of a state that an action changes, or that are then computed for the next one.
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
    cost: Float[Array, "s n"], penalty: Float[Array, "s m 2"], acted: Bool[Array, "s m"], gamma: Array | float
) -> tuple[Float[Array, " s"], Int[Array, " s"]]:
    """`prefix_values` of all sequences, which begin in the same state.

    If no sequence gains, penalties are dropped: first those of space that was not measured, the last ones, then those
    of touching the target, too. A risky action is better than none.
    """
    values = jax.vmap(functools.partial(prefix_values, gamma=gamma))
    wary, measured, free = (
        values(cost, risk, acted)
        for risk in (jnp.sum(penalty, axis=-1), penalty[..., 0], jnp.zeros_like(penalty[..., 0]))
    )

    def unless_stuck(chosen, bolder):
        stuck = jnp.min(chosen[0]) > -GAIN * cost[0, 0]
        return jax.tree.map(functools.partial(jnp.where, stuck), bolder, chosen)

    return unless_stuck(wary, unless_stuck(measured, free))


def present_state(problem: Problem, belief: Belief, objects: Superquadrics, config: PlannerConfig) -> State:
    """The state in which sequences begin, before any computation: as if every object had just moved.

    Args:
      problem, belief: constants of the search, and the present belief.
      objects: the recognised objects, fields (N, ...).
      config: settings of the planner.
    """
    scene, is_target = with_target(problem, belief, objects)
    count, spread = problem.existence.T_world_target.shape[:2]
    places = (count, spread) if config.as_in_paper else None
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
        # Where the target can be nowhere, no action has an aim.
        alive=belief.found | jnp.any(belief.exists),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """The model of a decision: what all its states share, and the step from one state to the next.

    Attributes:
      problem, belief: constants of the search, and the present belief.
      config: settings of the planner.
      propose, predict, objective: the slots.
    """

    problem: Problem
    belief: Belief
    config: PlannerConfig
    propose: Propose
    predict: Predict
    objective: Objective

    def root(self, objects: Superquadrics) -> State:
        """`present_state` of the rollout's problem and belief."""
        return present_state(self.problem, self.belief, objects, self.config)

    def update(self, state: State) -> State:
        """Bring f and g of a state up to date after `state.moved` moved."""
        problem, settings, grasps = self.problem, self.problem.config.existence, self.belief.grasps
        moved = state.moved
        objects = state.scene.replace(valid=state.scene.valid & ~state.is_target)
        if self.belief.exists.shape[-1] == 0:
            # Only the found pose counts; see `belief.without_candidates`.
            counts = self.objective.needs_graspability(self.belief, state)[-1]
            return state.replace(hits=found_hits(problem.target_grasps, grasps, objects, counts, state.hits, moved))
        counts_collisions = state.exists if self.config.as_in_paper else None
        views = object_views(
            problem.existence, problem.camera, objects, counts_collisions, settings, state.views, moved
        )
        here = jnp.where(self.belief.found, state.target_at, state.exists)
        belief = self.belief
        exists = existence(problem.existence, problem.camera, views, here, belief.allowed, settings, belief.measured)
        at_candidate_poses, at_found_pose = split_found(
            self.objective.needs_graspability(self.belief, state.replace(exists=exists))
        )
        rows = problem.grasps.pair_pose.shape[0]
        # After the target moved, other rows of H count, which are not computed yet.
        stale = moved | jnp.any(moved & state.is_target)
        hits = grasp_hits(problem.grasps, objects, at_candidate_poses, state.hits[:rows], stale)
        hits_at_found = found_hits(problem.target_grasps, grasps, objects, at_found_pose, state.hits[rows:], moved)
        return state.replace(exists=exists, views=views, hits=jnp.concatenate([hits, hits_at_found]))

    def candidates(self, state: State) -> AllCandidates:
        """Candidate actions of a state, brought up to date after `state.moved` moved."""
        possible = possible_space(self.problem, self.belief, state.exists)
        return all_candidates(self.problem.space, state.scene, possible, state.candidates, state.moved, state.able)

    def up_to_date(self, state: State) -> State:
        """Bring f, g and the candidate actions of a state up to date after `state.moved` moved."""
        state = self.update(state)
        return state.replace(candidates=self.candidates(state))

    def cost(self, state: State) -> Float[Array, ""]:
        """J of a state that is up to date."""
        return self.objective.cost(self.problem, self.belief, state, self.config.weights)

    def _draw(self, first: bool, state: State, key: Array) -> tuple[Sample, Prediction]:
        """An action and its prediction, drawn again until it is possible, at most as often as `config` allows."""

        def attempt(i, wanted):
            draw = jax.random.fold_in(key, i)
            guided = self.config.guided_fraction
            sample = self.propose(draw, self.problem, self.belief, self.objective, guided, state, wanted)
            return sample, self.predict(self.problem, state, sample, first)

        draws = self.config.draws[0 if first else 1]
        if draws == 1:
            return attempt(jnp.int32(0), state.alive)
        return (_draw_one_by_one if on_cpu() else _draw_all)(attempt, state, key, draws)

    def act(self, first: bool, state: State, key: Array) -> tuple[dict[str, Any], Action, Array]:
        """Sample an action in a state: the predicted changes, the action, and its penalties as shares of J, (2,).

        Args:
          first: whether it is the first of its sequence; static.
          state: up to date.
          key: PRNG key.
        """
        sample, prediction = self._draw(first, state, key)
        acted = prediction.possible & state.alive
        action = sample.action.replace(kind=jnp.where(acted, sample.action.kind, ActionKind.NONE).astype(jnp.int32))
        spent = (jnp.arange(state.scene.capacity) == action.object) & (not self.config.as_in_paper)
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

    def contact_probability(self, state: State, sample: Sample) -> Float[Array, "2"]:
        """Share of the possible poses at which an action would touch the target, where it was drawn; and whether it
        enters space that was not measured.
        """
        possible = possible_space(self.problem, self.belief, state.exists)
        return contact_probability(self.problem.space, state.scene, possible, sample)

    def step(self, states: State, keys: Array, time: Int[Array, ""]):
        """Advance sequences that have begun by one action: the states after it, and records of the states before it."""
        states = jax.vmap(self.update)(states)

        def act_all():
            candidates = jax.vmap(self.candidates)(states)
            now = states.replace(candidates=candidates)
            changes, actions, penalty = jax.vmap(functools.partial(self.act, False))(now, keys)
            return changes | {"candidates": candidates}, actions, penalty

        def stay():
            count = keys.shape[0]
            changes = {name: getattr(states, name) for name in CHANGING}
            return changes, repeated(no_action(), count), jnp.zeros((count, 2))

        # After the last action only the cost counts. Fields that actions do not change stay out of the branches.
        changes, actions, penalty = jax.lax.cond(time < self.config.horizon, act_all, stay)
        kept = (actions, jax.vmap(self.cost)(states), penalty)
        return states.replace(**changes), kept


def _draw_one_by_one(attempt: Attempt, state: State, key: Array, draws: int) -> tuple[Sample, Prediction]:
    """The first possible attempt, without computing later ones: fastest on a CPU."""

    def again(carry):
        i, (_, prediction) = carry
        # In a batch, sequences that have an action loop with the others.
        return i + 1, attempt(i, state.alive & ~prediction.possible)

    def goes_on(carry):
        i, (_, prediction) = carry
        return (i < draws) & ~prediction.possible & state.alive

    return jax.lax.while_loop(goes_on, again, _begin(attempt, state, key))[1]


def _draw_all(attempt: Attempt, state: State, key: Array, draws: int) -> tuple[Sample, Prediction]:
    """The first possible attempt in two rounds, the first attempt and then all others: fastest on a GPU."""
    others = jnp.arange(draws - 1, dtype=jnp.int32)

    def again(carry):
        turn, (_, prediction) = carry
        wanted = state.alive & ~prediction.possible & ((turn > 0) | (others == 0))
        sample, predicted = jax.vmap(attempt)(others + turn, wanted)
        drawn = sample, predicted.replace(possible=predicted.possible & wanted)
        first = jnp.argmax(drawn[1].possible)
        return turn + 1, jax.tree.map(lambda new, old: jnp.where(prediction.possible, old, new[first]), drawn, carry[1])

    def goes_on(carry):
        turn, (_, prediction) = carry
        return (turn < 2) & ~prediction.possible & state.alive

    return jax.lax.while_loop(goes_on, again, _begin(attempt, state, key))[1]


def _begin(attempt: Attempt, state: State, key: Array) -> tuple[Array, tuple[Sample, Prediction]]:
    """What loops over attempts begin with: no attempt yet."""
    shapes = jax.eval_shape(lambda: attempt(jnp.int32(0), state.alive)[0])
    blank = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    nothing = Prediction(state.scene, jnp.zeros_like(state.moved), jnp.array(False))
    # All that changes varies with the key from the beginning: JAX would trace the loop once more to find that it does.
    either = jax.random.key_data(key)[0] == 0
    return jax.tree.map(lambda a: jnp.where(either, a, a), (jnp.int32(0), (blank, nothing)))


def first_equal(tree: Any) -> Int[Array, " s"]:
    """For each row of a pytree, the number of the first row that is equal to it."""
    rows = jnp.concatenate([a.reshape(a.shape[0], -1).astype(jnp.float32) for a in jax.tree.leaves(tree)], axis=1)
    return jnp.argmax(jnp.all(rows[:, None] == rows[None], axis=-1), axis=1)


def repeated(tree: Any, count: int) -> Any:
    """A pytree repeated along a new leading axis of length `count`."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), tree)


def plan(rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
    """Decide on the next action by sampling sequences and keeping the first action of the best (B.4).

    Args:
      rollout: problem, belief and slots.
      key: PRNG key of the planner.
      objects: the recognised objects, fields (N, ...).

    Returns:
      The decision. The same arguments give the same decision, also under `vmap`.
    """
    config = rollout.config
    count, horizon = config.sequences, config.horizon
    keys = jnp.swapaxes(jax.vmap(lambda k: jax.random.split(k, horizon + 1))(jax.random.split(key, count)), 0, 1)
    # All sequences begin in the same state, which is computed once.
    root = rollout.up_to_date(rollout.root(objects))
    changes, actions, penalty = jax.vmap(functools.partial(rollout.act, True, root))(keys[0])
    scenes = changes["scene"]
    if horizon == 1:
        # Pushes are often drawn again: of equal actions only the first is looked at.
        first = first_equal(actions)
        changes["moved"] &= (first == jnp.arange(count))[:, None]
        after = jax.vmap(lambda changes: rollout.cost(rollout.update(root.replace(**changes))))(changes)[first]
        actions, penalty, cost = jax.tree.map(lambda a: a[:, None], (actions, penalty, after))
    else:
        states = repeated(root, count).replace(**changes)
        times = 1 + jnp.arange(horizon)
        _, later = jax.lax.scan(lambda states, now: rollout.step(states, *now), states, (keys[1:], times))
        later_actions, cost, later_penalty = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), later)
        actions, penalty = jax.tree.map(
            lambda a, b: jnp.concatenate([a[:, None], b[:, :-1]], axis=1),
            (actions, penalty),
            (later_actions, later_penalty),
        )
    now = rollout.cost(root)
    cost = jnp.concatenate([jnp.broadcast_to(now, (count, 1)), cost], axis=1)
    value, length = sequence_values(cost, penalty * cost[:, :-1, None], actions.kind != ActionKind.NONE, config.gamma)
    # Without the target's slot, the last.
    after = jax.tree.map(lambda a: a[:, : objects.capacity], scenes)
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
    """Sequences of a decision that samples none: no actions, and the present objects after them."""
    count, horizon = config.sequences, config.horizon
    return Sequences(
        actions=repeated(repeated(no_action(), horizon), count),
        cost=jnp.full((count, horizon), jnp.nan),
        value=jnp.full(count, jnp.inf),
        length=jnp.ones(count, jnp.int32),
        after=repeated(objects, count),
    )


def no_decision(objects: Superquadrics) -> Decision:
    """The decision to do nothing, for which nothing was considered."""
    nothing = no_sequences(PlannerConfig(horizon=1, sequences=1), objects)
    unknown = jnp.float32(jnp.nan)
    return Decision(no_action(), jnp.float32(jnp.inf), unknown, unknown, objects, nothing)
