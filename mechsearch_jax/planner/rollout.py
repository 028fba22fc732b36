"""The engine: sampling-based model predictive control over predicted states (paper sections 3 and 4.4, appendix B.4).

All sequences of actions are sampled in one vmapped computation, each action in the predicted state of its step, and the
first action of the best sequence is taken. What draws go to, sampling, prediction and the cost are slots.
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
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.belief.belief import Belief, possible_space, problem_without_candidates, with_target
from mechsearch_jax.belief.moved_target import candidate_of
from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.existence import existence, no_views, object_views
from mechsearch_jax.geometry.masked import on_cpu
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.grasping.graspability import grasp_hits, no_hits, pairs, split_found
from mechsearch_jax.grasping.retrieval import found_hits
from mechsearch_jax.planner.objective import Objective
from mechsearch_jax.planner.prediction import Predict
from mechsearch_jax.planner.proposal import ObjectWeights, Propose, weighted_draw
from mechsearch_jax.planner.state import Decision, Sequences, State
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.pytree import PyTreeNode

# Least decrease of J, as a share of J, that counts as a gain.
GAIN = 0.02
# Draws an action and predicts it, given the number of the draw and whether it counts.
Attempt = Callable[[Array, Array], tuple[Sample, Prediction]]
# The number of attempts so far, and the last one.
Drawing = tuple[Array, tuple[Sample, Prediction]]
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


def without_poses(problem: Problem, state: State) -> tuple[Problem, State]:
    """Problem and state without what has a row for each candidate pose or grasp of the target.

    Candidate actions, draws and predictions do not need it, so that their programs are the same for a hidden and for a
    found target.
    """
    return problem_without_candidates(problem), state.replace(exists=None, target_at=None, views=None, hits=None)


class Drawn(PyTreeNode):
    """An action that was drawn in a state, and what it is predicted to do.

    Attributes:
      action: of kind NONE if none is possible.
      prediction: its effect.
      contact: see `contact_probability`, shape (2,).
    """

    action: Action
    prediction: Prediction
    contact: jax.Array


@cached_jit()
def candidates_of(problem: Problem, state: State, possible: PossibleSpace) -> AllCandidates:
    """Candidate actions of a state, brought up to date after `state.moved` moved; see `without_poses`."""
    return all_candidates(problem.space, state.scene, possible, state.candidates, state.moved, state.able)


def draw(
    propose: Propose,
    predict: Predict,
    first: bool,
    draws: int,
    problem: Problem,
    state: State,
    possible: PossibleSpace,
    weights: Float[Array, " n"],
    key: Array,
) -> Drawn:
    """An action and its prediction, drawn again until it is possible, at most `draws` times.

    Args:
      propose, predict: the slots.
      first: whether it is the first of its sequence.
      draws: the most draws.
      problem, state: see `without_poses`.
      possible: where the target may be.
      weights: sampling weight of each object.
      key: PRNG key.
    """

    def sampled(i, wanted):
        return propose(jax.random.fold_in(key, i), problem, state, possible, weights, wanted)

    def attempt(i, wanted):
        sample = sampled(i, wanted)
        return sample, predict(problem, state, sample, first)

    if draws == 1:
        sample, prediction = attempt(jnp.int32(0), state.alive)
    else:
        start = _nothing_drawn(sampled, state, key)
        sample, prediction = (_draw_one_by_one if on_cpu() else _draw_all)(attempt, start, state, draws)
    contact = contact_probability(problem.space, state.scene, possible, sample)
    return Drawn(sample.action, prediction, contact)


@cached_jit(static_argnames=("propose", "predict", "draws"))
def first_draws(
    propose: Propose,
    predict: Predict,
    draws: int,
    problem: Problem,
    state: State,
    possible: PossibleSpace,
    weights: Float[Array, " n"],
    keys: Array,
) -> Drawn:
    """`draw` of the first action of sequences, one for each key, fields (S, ...)."""
    return jax.vmap(functools.partial(draw, propose, predict, True, draws, problem, state, possible, weights))(keys)


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """The model of a decision: what all its states share, and the step from one state to the next.

    Attributes:
      problem, belief: constants of the search, and the present belief.
      config: settings of the planner.
      weigh, predict, objective, propose: the slots.
    """

    problem: Problem
    belief: Belief
    config: PlannerConfig
    weigh: ObjectWeights
    predict: Predict
    objective: Objective
    propose: Propose = weighted_draw

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

    def possible(self, state: State) -> PossibleSpace:
        """Where the target may be in a state."""
        return possible_space(self.problem, self.belief, state.exists)

    def candidates(self, state: State) -> AllCandidates:
        """Candidate actions of a state, brought up to date after `state.moved` moved."""
        return candidates_of(*without_poses(self.problem, state), self.possible(state))

    def weights(self, state: State) -> Float[Array, " n"]:
        """Sampling weight of each object in a state that is up to date."""
        return self.weigh(self.problem, self.belief, self.objective, self.config.guided_fraction, state)

    def drawing(self, root: State, begun: Begun, weights: Any) -> tuple[Any, ...]:
        """The arguments of `first_draws` in a state that is up to date, or their shapes."""
        bare = without_poses(self.problem, root)
        return self.propose, self.predict, self.config.draws[0], *bare, begun.possible, weights, begun.keys

    def up_to_date(self, state: State) -> State:
        """Bring f, g and the candidate actions of a state up to date after `state.moved` moved."""
        state = self.update(state)
        return state.replace(candidates=self.candidates(state))

    def cost(self, state: State) -> Float[Array, ""]:
        """J of a state that is up to date."""
        return self.objective.cost(self.problem, self.belief, state, self.config.weights)

    def act(self, first: bool, state: State, key: Array) -> tuple[dict[str, Any], Action, Array]:
        """Sample an action in a state: the predicted changes, the action, and its penalties as shares of J, (2,).

        Args:
          first: whether it is the first of its sequence; static.
          state: up to date.
          key: PRNG key.
        """
        draws = self.config.draws[0 if first else 1]
        bare = without_poses(self.problem, state)
        drawn = draw(self.propose, self.predict, first, draws, *bare, self.possible(state), self.weights(state), key)
        return self.outcome(state, drawn)

    def outcome(self, state: State, drawn: Drawn) -> tuple[dict[str, Any], Action, Array]:
        """What a drawn action changes in a state, the action, and its penalties as shares of J, (2,)."""
        prediction = drawn.prediction
        acted = prediction.possible & state.alive
        action = drawn.action.replace(kind=jnp.where(acted, drawn.action.kind, ActionKind.NONE).astype(jnp.int32))
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
        return changes, action, self.config.unseen_contact_penalty * drawn.contact

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


def _draw_one_by_one(attempt: Attempt, start: Drawing, state: State, draws: int) -> tuple[Sample, Prediction]:
    """The first possible attempt, without computing later ones: fastest on a CPU."""

    def again(carry):
        i, (_, prediction) = carry
        # In a batch, sequences that have an action loop with the others.
        return i + 1, attempt(i, state.alive & ~prediction.possible)

    def goes_on(carry):
        i, (_, prediction) = carry
        return (i < draws) & ~prediction.possible & state.alive

    return jax.lax.while_loop(goes_on, again, start)[1]


def _draw_all(attempt: Attempt, start: Drawing, state: State, draws: int) -> tuple[Sample, Prediction]:
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

    return jax.lax.while_loop(goes_on, again, start)[1]


def _nothing_drawn(sampled: Callable[[Array, Array], Sample], state: State, key: Array) -> Drawing:
    """What loops over attempts begin with: no attempt yet."""
    shapes = jax.eval_shape(lambda: sampled(jnp.int32(0), state.alive))
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


class Begun(PyTreeNode):
    """What the draws of first actions begin with.

    Attributes:
      state: the present one, with f and g; its candidate actions come next.
      possible: where the target may be.
      keys, later: of the first actions, shape (S,), and of what follows, shape (M, S).
    """

    state: State
    possible: PossibleSpace
    keys: jax.Array
    later: jax.Array


def begin(rollout: Rollout, key: Array, objects: Superquadrics) -> Begun:
    """The first part of `plan`: all sequences begin in the same state, which is computed once."""
    root = rollout.update(rollout.root(objects))
    return Begun(root, rollout.possible(root), *_keys(rollout.config, key))


def _keys(config: PlannerConfig, key: Array) -> tuple[Array, Array]:
    keys = jax.vmap(lambda k: jax.random.split(k, config.horizon + 1))(jax.random.split(key, config.sequences))
    keys = jnp.swapaxes(keys, 0, 1)
    return keys[0], keys[1:]


def plan(rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
    """Decide on the next action by sampling sequences and keeping the first action of the best (B.4).

    Args:
      rollout: problem, belief and slots.
      key: PRNG key of the planner.
      objects: the recognised objects, fields (N, ...).

    Returns:
      The decision. The same arguments give the same decision, also under `vmap`.
    """
    begun = begin(rollout, key, objects)
    root = begun.state.replace(candidates=rollout.candidates(begun.state))
    drawn = first_draws(*rollout.drawing(root, begun, rollout.weights(root)))
    return decide(rollout, root, begun.later, drawn)


def shapes_of_parts(rollout: Rollout, key: Array, objects: Superquadrics) -> tuple[Any, Any, Any]:
    """Shapes of what passes between the parts of `plan`, of which none is traced: begun, weights and drawn."""

    def parts(problem: Problem, belief: Belief, key: Array, objects: Superquadrics) -> tuple[Begun, Array, Drawn]:
        traced = dataclasses.replace(rollout, problem=problem, belief=belief)
        root = traced.root(objects)
        begun = Begun(root, traced.possible(root), *_keys(rollout.config, key))
        drawn = Drawn(no_action(), Prediction(root.scene, root.moved, root.alive), jnp.zeros(2))
        return begun, jnp.zeros(root.scene.capacity), repeated(drawn, rollout.config.sequences)

    return jax.eval_shape(parts, rollout.problem, rollout.belief, key, objects)


def decide(rollout: Rollout, root: State, later: Array, drawn: Drawn) -> Decision:
    """The last part of `plan`: what the drawn actions come to.

    Args:
      rollout: problem, belief and slots.
      root: the present state, up to date.
      later: see `Begun`.
      drawn: the first action of each sequence, fields (S, ...).
    """
    config = rollout.config
    count, horizon = config.sequences, config.horizon
    changes, actions, penalty = jax.vmap(functools.partial(rollout.outcome, root))(drawn)
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
        _, records = jax.lax.scan(lambda states, now: rollout.step(states, *now), states, (later, times))
        later_actions, cost, later_penalty = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), records)
        actions, penalty = jax.tree.map(
            lambda a, b: jnp.concatenate([a[:, None], b[:, :-1]], axis=1),
            (actions, penalty),
            (later_actions, later_penalty),
        )
    now = rollout.cost(root)
    cost = jnp.concatenate([jnp.broadcast_to(now, (count, 1)), cost], axis=1)
    value, length = sequence_values(cost, penalty * cost[:, :-1, None], actions.kind != ActionKind.NONE, config.gamma)
    # Without the target's slot, the last.
    after = jax.tree.map(lambda a: a[:, :-1], scenes)
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
