"""What the robot can do: one file for each kind of action, their registry, and how they are sampled."""

from mechsearch_jax.actions.candidates import (
    AllCandidates,
    all_candidates,
    free_candidates,
    no_candidates,
    sample_action,
)
from mechsearch_jax.actions.config import ActionConfig, ActionSpace, ActionTables, action_tables
from mechsearch_jax.actions.kind import Kind, SampledKind, Sketch
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.actions.registry import KINDS, SAMPLED_KINDS, ActionKind, kind_of
from mechsearch_jax.actions.trajectory import JointTrajectory, joint_trajectory
from mechsearch_jax.actions.types import Action, Candidates, Prediction, Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace, widen

__all__ = [
    "KINDS",
    "SAMPLED_KINDS",
    "Action",
    "ActionConfig",
    "ActionKind",
    "ActionSpace",
    "ActionTables",
    "AllCandidates",
    "Candidates",
    "JointTrajectory",
    "Kind",
    "PossibleSpace",
    "Prediction",
    "Sample",
    "SampledKind",
    "Sketch",
    "action_tables",
    "all_candidates",
    "free_candidates",
    "joint_trajectory",
    "kind_of",
    "no_action",
    "no_candidates",
    "retrieve_action",
    "sample_action",
    "widen",
]
