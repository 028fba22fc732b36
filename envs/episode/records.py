"""The record of an episode, `episode.json`."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np

from mechsearch_jax.actions import Action, kind_of
from mechsearch_jax.config.fixed import renamed
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json, replacing


@dataclasses.dataclass(frozen=True)
class ActionRecord:
    """An action in a file; fields as in `mechsearch_jax.actions.Action`.

    Attributes:
      kind: name of a registered kind: "push", "pick-and-place", "retrieve", "none", ...
      object: index of the object in the scenario; None if the action moves no object, for example for a retrieval, or
        one that was recognised where nothing is.
      T_world_gripper, T_world_place: rows of the 4 x 4 poses [m].
      displacement: [m].
      q7: [rad].
      opening: [m].
    """

    kind: str
    object: int | None
    T_world_gripper: list[list[float]]
    displacement: list[float]
    T_world_place: list[list[float]]
    q7: float
    opening: float


def record_action(action: Action) -> ActionRecord:
    """The record of a single action.

    Raises:
      InputError: its kind is unknown.
    """
    kind = kind_of(int(action.kind))
    return ActionRecord(
        kind=kind.name,
        object=int(action.object) if kind.moves_object else None,
        T_world_gripper=np.asarray(action.T_world_gripper).tolist(),
        displacement=np.asarray(action.displacement).tolist(),
        T_world_place=np.asarray(action.T_world_place).tolist(),
        q7=float(action.q7),
        opening=float(action.opening),
    )


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of an episode: belief, decision and result.

    Attributes:
      belief_size: number of candidate poses where the target can still be.
      found: whether the target has been found, and may still be where it was seen last.
      graspable: whether it has been found and a collision-free grasp of it exists in the true state.
      cost: J of the observed state; None if nothing was planned.
      action: of the robot; None if the episode ended here.
      predicted_cost: predicted J after the action; None if nothing was planned or predicted.
      observed_cost: J at the next observation; None if there was none.
      sequences: number of valid action sequences from which the plan was chosen.
      failure: why the action could not be carried out as planned; None if it was.
      timings: wall time of each stage [s], each without compilation, which is "compile" if there was any.
      truth_possible: whether f holds the candidate pose that is nearest to the target's true pose; None once the target
        is found, and where it has fallen, so that no candidate is near its pose.
      restarts: how often f has become empty and was started anew.
      fallen: indices in the scenario of the objects that left the board in this step.
      target_fallen: whether the target did; False while it is in the hand.
      held_up: whether the arm was held up: see `SimulatorConfig.tracking_bound`, and `Mismatch.arm_stop`.
      at_rest: whether everything came to rest after the action; False also where the simulation diverged.
      restless: what did not, in words, as "object 0 leans on the back wall"; None in records that do not say.
      tracking_error: largest distance of a joint from its reference [rad].
      paper_graspable: whether `graspable` holds with the paper's grasps alone: see `verdicts.paper_grasps`.
      around_possible: whether f holds any candidate pose of the true pose's cell or of the eight cells around it; None
        where `truth_possible` is.
      blind: whether the action sweeps space of which nothing was measured; None where nothing was decided.

    From `fallen` to `tracking_error` they are None where nothing was executed.
    """

    belief_size: int
    found: bool
    graspable: bool
    cost: float | None
    action: ActionRecord | None
    predicted_cost: float | None
    observed_cost: float | None
    sequences: int
    failure: str | None
    timings: dict[str, float]
    truth_possible: bool | None = None
    restarts: int = 0
    fallen: tuple[int, ...] | None = None
    target_fallen: bool | None = None
    held_up: bool | None = None
    at_rest: bool | None = None
    restless: tuple[str, ...] | None = None
    tracking_error: float | None = None
    paper_graspable: bool = False
    around_possible: bool | None = None
    blind: bool | None = None

    @property
    def compares_costs(self) -> bool:
        """Whether the policy chose by costs: those of one that does not, such as `random`, are all 0."""
        return bool(self.cost or self.predicted_cost or self.observed_cost)


@dataclasses.dataclass(frozen=True)
class Episode:
    """A whole episode, from the first look to the retrieval or to giving up.

    Attributes:
      scenario: name of the scenario.
      objects: number of surrounding objects.
      config: the planner's and the episode's options.
      versions: as `versions` returns them.
      steps: one for each observation.
      found_step: number of actions before the target was found; None where it never was.
      graspable_step: number of actions before the first `graspable` step, retrieved or not; None if there was none.
      retrieved: whether the hand took the target out of the shelf and no object fell off the board, neither then nor
        before.
      failure: why the episode ended without a retrieval; None after one. Where an object left the board, this is the
        reason, with the number of the action.
      content_hash: of the scenario, see `Scenario.content_hash`.
      paper_graspable_step: number of actions before it could be grasped with the paper's grasps alone; None where it
        could not before the episode ended.
    """

    scenario: str
    objects: int
    config: dict[str, Any]
    versions: dict[str, str]
    steps: tuple[Step, ...]
    found_step: int | None
    graspable_step: int | None
    retrieved: bool
    failure: str | None
    content_hash: str = ""
    paper_graspable_step: int | None = None


def save_episode(episode: Episode, path: PathLike) -> None:
    """Write `episode.json`.

    Raises:
      InputError: the file cannot be written.
    """
    text = json.dumps(dataclasses.asdict(episode), indent=1, allow_nan=False) + "\n"
    with replacing(path) as file:
        file.write(text.encode())


def load_episode(path: PathLike) -> Episode:
    """Read `episode.json`.

    Raises:
      InputError: the file cannot be read or is not the record of an episode.
    """
    value = read_json(path)
    try:
        return episode_of(value)
    except (TypeError, KeyError) as error:
        raise InputError(f"{path}: is not the record of an episode ({error})") from error


def episode_of(value: Any) -> Episode:
    """An episode from its JSON values.

    Raises:
      TypeError, KeyError: they are of something else.
    """
    steps = tuple(_step(step) for step in value["steps"])
    return Episode(**{**value, "steps": steps, "config": renamed(value["config"])})


def _step(value: Any) -> Step:
    """A step from its JSON values."""
    action, fallen, restless = value["action"], value.get("fallen"), value.get("restless")
    return Step(
        **{
            **value,
            "action": None if action is None else ActionRecord(**action),
            "fallen": None if fallen is None else tuple(fallen),
            "restless": None if restless is None else tuple(restless),
        }
    )
