"""What every kind of action offers, one file each; `registry` lists them."""

from __future__ import annotations

import abc
import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.config import ActionSpace
from mechsearch_jax.actions.types import Action, Candidates, DrawnCandidate, Prediction, Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.geometry.footprints import Footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.robot.motion import MotionConfig, Reference


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Lines in the world; every part may be missing.

    Attributes:
      hands: poses of the gripper, first where the action begins, shape (k, 4, 4) [m].
      opening: distance between its fingers [m].
      path: path of the hand or of the object in it, drawn as an arrow, shape (points, 3) [m].
      takes_target: whether the target moves along the path.
    """

    hands: Float[np.ndarray, "k 4 4"] | None = None
    opening: float = 0.0
    path: Float[np.ndarray, "points 3"] | None = None
    takes_target: bool = False


class Kind(abc.ABC):
    """A kind of action.

    Attributes:
      code: its value in `Action.kind`.
      name: what files and the command line call it.
      moves_object: whether it moves the object `Action.object`.
      holds_object: whether that object must stay in the closed hand from grasp to release.
      takes_target: whether it must end with the target in the closed hand, outside the shelf.
      returns_home: whether the robot is back in its home configuration afterwards.
    """

    code: int
    name: str
    moves_object: bool = False
    holds_object: bool = False
    takes_target: bool = False
    returns_home: bool = False

    @abc.abstractmethod
    def predict(
        self,
        space: ActionSpace,
        push_model: PushModel,
        scene: Superquadrics,
        untouchable: Bool[Array, " n"],
        action: Action,
        wrist: Int[Array, ""],
    ) -> Prediction:
        """Predict the objects after an action; also called with actions of other kinds, where the result is ignored.

        Args:
          space: what all actions share.
          push_model: predicts pushes.
          scene: the objects, fields (N, ...).
          untouchable: which objects must not be moved, shape (N,).
          action: a single action.
          wrist: index of its wrist angle.
        """

    def reference(self, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]] | None:
        """The motion of arm and fingers, and whether the arm reaches all of it; None for a kind without motion."""
        return None

    @abc.abstractmethod
    def sketch(self, scene: Superquadrics, after: Superquadrics, action: Action) -> Sketch:
        """What a picture shows of an action, from the objects before it and those predicted after it."""

    @abc.abstractmethod
    def describe(self, action: Action, target: int | None = None) -> str:
        """A single action in words, with directions as seen by the robot.

        Args:
          action: of this kind.
          target: the object index that stands for the target; None if there is none.
        """


class SampledKind(Kind):
    """A kind of action that moves an object and from which sequences are sampled.

    Every object has V x D candidates: V gripper poses, each with D distances.

    Attributes:
      opening: the gripper's state on the approach, `config.OPEN` or `config.CLOSED`.
      surrounds_object: whether the fingers enclose the object, which is then no obstacle.
      moves_target: whether it may move a found target.
    """

    opening: int
    surrounds_object: bool
    moves_target: bool

    @abc.abstractmethod
    def wrists(self, space: ActionSpace) -> Int[np.ndarray, " v"]:
        """Index of the wrist angle of each gripper pose."""

    @abc.abstractmethod
    def distances(self, space: ActionSpace) -> int:
        """The number of distances D."""

    @abc.abstractmethod
    def propose(
        self, space: ActionSpace, scene: Superquadrics, prints: Footprints, fresh: Bool[Array, " n"]
    ) -> tuple[Float[Array, "n v 4 4"], Float[Array, "n v"]]:
        """Gripper poses of all candidates, and their `Candidates.weight`; only those of `fresh` objects are used."""

    @abc.abstractmethod
    def travels(self, space: ActionSpace, T: Float[Array, "k 4 4"], near: Bool[Array, " k"]) -> Bool[Array, "k d"]:
        """Whether arm and shelf allow the motion after the approach; K = N V gripper poses.

        Args:
          space: what all actions share.
          T: gripper poses, object by object.
          near: whether the arm can approach each pose; the result is False elsewhere.
        """

    @abc.abstractmethod
    def swept_hits(
        self, space: ActionSpace, scene: Superquadrics, T: Float[Array, "k 4 4"], mask: Bool[Array, "k n"]
    ) -> Bool[Array, "k n"]:
        """Which objects the grasped object hits on its way out, where the mask is true."""

    @abc.abstractmethod
    def entering(
        self, space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, candidates: Candidates
    ) -> Bool[Array, "n v d"]:
        """Which candidates enter space where the target may be; tested only for candidates that hit nothing."""

    @abc.abstractmethod
    def draft(
        self,
        key: jax.Array,
        space: ActionSpace,
        scene: Superquadrics,
        possible: PossibleSpace,
        candidates: Candidates,
        drawn: DrawnCandidate,
    ) -> tuple[Bool[Array, ""], Sample]:
        """Whether a drawn candidate can be executed, and its action; its number may be out of range if not `wanted`."""
