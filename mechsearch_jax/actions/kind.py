"""What a kind of action has to offer: one file for each kind, named in `registry`."""

from __future__ import annotations

from typing import Protocol

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.config import ActionSpace
from mechsearch_jax.actions.sketch import Sketch
from mechsearch_jax.actions.types import Action, Draft, DrawnWay, Prediction, Ways
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.geometry.footprints import Footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.robot.motion import MotionConfig, Reference


class Kind(Protocol):
    """A kind of action.

    Attributes:
      code: its value in `Action.kind`.
      name: what files and the command line call it.
      moves_object: whether it moves the object `Action.object`.
      holds_object: whether that object must stay in the closed hand from grasp to release.
      takes_target: whether it is to end with the target in the closed hand, outside the shelf.
      returns_home: whether the robot is back in its home configuration afterwards.
    """

    @property
    def code(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def moves_object(self) -> bool: ...
    @property
    def holds_object(self) -> bool: ...
    @property
    def takes_target(self) -> bool: ...
    @property
    def returns_home(self) -> bool: ...

    def predict(
        self,
        space: ActionSpace,
        push_model: PushModel,
        scene: Superquadrics,
        untouchable: Bool[Array, " n"],
        action: Action,
        wrist: Int[Array, ""],
    ) -> Prediction:
        """What an action of this kind does to the objects; called for actions of other kinds too, and then ignored.

        Args:
          space: what all actions share.
          push_model: predicts pushes.
          scene: the objects, fields (N, ...).
          untouchable: which of them must not be moved.
          action: a single action.
          wrist: index of its wrist angle.
        """
        ...

    def reference(self, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]] | None:
        """The motion of arm and fingers, and whether the arm reaches all of it; None for a kind that does not move."""
        ...

    def sketch(self, scene: Superquadrics, after: Superquadrics, action: Action) -> Sketch:
        """What a picture shows of an action, from the objects before it and as they are predicted after it."""
        ...

    def describe(self, action: Action, target: int | None = None) -> str:
        """A single action in words, as the robot sees it.

        Args:
          action: of this kind.
          target: the index that stands for the target, if any does.
        """
        ...


class SampledKind(Kind, Protocol):
    """A kind of action that moves an object and that sequences are sampled from.

    Every object has V ways to be moved so, each by D distances.

    Attributes:
      opening: which of the gripper's swept clouds its approach is tested with, `config.OPEN` or `config.CLOSED`.
      surrounds_object: whether the fingers are around the object, which is then no obstacle.
      moves_target: whether it may move a target that has been found like any other object.
    """

    @property
    def opening(self) -> int: ...
    @property
    def surrounds_object(self) -> bool: ...
    @property
    def moves_target(self) -> bool: ...

    def wrists(self, space: ActionSpace) -> Int[np.ndarray, " v"]:
        """Index of the wrist angle of each way."""
        ...

    def distances(self, space: ActionSpace) -> int:
        """D."""
        ...

    def propose(
        self, space: ActionSpace, scene: Superquadrics, prints: Footprints, fresh: Bool[Array, " n"]
    ) -> tuple[Float[Array, "n v 4 4"], Float[Array, "n v"]]:
        """Gripper poses of all ways, and their `Ways.weight`; of objects that are not `fresh`, anything."""
        ...

    def travels(self, space: ActionSpace, T: Float[Array, "k 4 4"], near: Bool[Array, " k"]) -> Bool[Array, "k d"]:
        """Whether arm and shelf allow the rest of the motion, for all ways of all objects whose approach is `near`."""
        ...

    def swept_hits(
        self, space: ActionSpace, scene: Superquadrics, T: Float[Array, "k 4 4"], mask: Bool[Array, "k n"]
    ) -> Bool[Array, "k n"]:
        """Which objects what is in the hand runs into, where the mask is true."""
        ...

    def entering(
        self, space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, ways: Ways
    ) -> Bool[Array, "n v d"]:
        """Which ways enter space where the target may be; looked at only where nothing stands in the way."""
        ...

    def draft(
        self,
        key: jax.Array,
        space: ActionSpace,
        scene: Superquadrics,
        possible: PossibleSpace,
        ways: Ways,
        drawn: DrawnWay,
    ) -> Draft:
        """An action from a way that was drawn, whose number may be out of range where it is not wanted."""
        ...
