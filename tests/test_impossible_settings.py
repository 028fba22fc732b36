"""Settings that make no sense are refused in one line, which names what is wrong."""

import pytest

from mechsearch_jax.actions.kinds.object_grasps import BoxGrasp, ObjectGraspConfig
from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.dynamics.learned import LearnedPush
from mechsearch_jax.envs.cell.simulated_cell import SensorNoise
from mechsearch_jax.envs.pushing.pushes import Generation
from mechsearch_jax.envs.simulators.mjx_model import MjxConfig
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.nearby import Perturbations
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.networks.push import PushConfig
from mechsearch_jax.perception.doubt import DoubtConfig
from mechsearch_jax.perception.explanation import ExplanationConfig
from mechsearch_jax.perception.parts.in_parts import PartsConfig
from mechsearch_jax.perception.parts.segments import SegmentsConfig
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.robot.arm_config import ArmConfig
from mechsearch_jax.robot.free_motion import FreeMotionConfig
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.hand import HandConfig
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.robot.robot_trajectory import Bounds
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig
from mechsearch_jax.train.places import Places
from mechsearch_jax.train.scenes import SceneConfig
from mechsearch_jax.workspace.target import Target

NAN, INFINITE = float("nan"), float("inf")
# What is made, which words its refusal has, and what is given; None stands for the name of the setting.
IMPOSSIBLE = (
    (PlannerConfig, None, {"guided_fraction": 1.0}, {"unseen_contact_penalty": -1.0}, {"crowding_weight": NAN}),
    (BoxGrasp, "face must be", {"turn": 1.5}, {"reach": 0.0}, {"drop": 0.0}, {"face": 4}),
    (ObjectGraspConfig, "at least one", {"boxes": ()}),
    (LearnedPush, "likely .* max_penetration", {"likely": 1.5}, {"likely": NAN}, {"max_penetration": -0.01}),
    (PushConfig, None, {"width": 0}, {"layers": 0}, {"frame": "gripper"}),
    (SensorNoise, "missing a share below 1", {"missing": 1.0}),
    (MjxConfig, None, {"contacts": 0}, {"rows": 0}, {"compound_contacts": 0}, {"compound_rows": 0}),
    (SimulatorConfig, None, {"tracking_bound": 0}, {"settle_steps": -1.0}, {"slip": NAN}),
    (MotionConfig, "must be positive", {"timestep": 0.0}),
    (MotionConfig, None, {"waypoints": 1}, {"carry_pace": 1.5}),
    (Perturbations, None, {"friction": 0.9}, {"friction": NAN}, {"scenes": -1}, {"place": INFINITE}, {"size": NAN}),
    (TargetColour, "TargetColour", {"rgb": (2.0, 0.0, 0.0)}, {"threshold": 0.0}),
    (ExplanationConfig, None, {"gain": -1.0}, {"wrong": 0.0}, {"splits": 17}),
    (PartsConfig, None, {"wrong": 0.0}, {"part": -1.0}),
    (
        RefinementConfig,
        "RefinementConfig",
        {"points": 0},
        {"noise": -1.0},
        {"stages": ()},
        {"hypotheses": ((0.0, 1.0, 0.0),)},
    ),
    (SegmentsConfig, None, {"jump": 0.0}, {"border": -1.0}, {"least": NAN}),
    (FreeMotionConfig, "FreeMotionConfig", {"step": 0.03}, {"clearance": 0.3}, {"attempts": 0}, {"slack": NAN}),
    (Gripper, None, {"usable_opening": 0.1}, {"approach": 0.0}),
    (HandConfig, None, {"speed": 0.0}, {"force": 500.0}, {"inner": 0.0}, {"settle": -1.0}),
    (ArmConfig, None, {"place": (1.0, 2.0)}, {"place": (0.0, 0.0, 3.0)}, {"place": (9.0,) * 7}),
    (TrajectoryConfig, None, {"place": (NAN, 0.0, 0.0)}),
    (Bounds, "Bounds", {"tracking": 0.0}, {"force": -1.0}, {"effort": (1.0, 2.0)}),
    (DoubtConfig, "DoubtConfig", {"passed": 2.0}),
    (Target, "a cylinder's first two are its radius", {"half_size": (0.02, 0.03, 0.05)}),
    (Target, 'shape: "can" is unknown; use "box" or "cylinder"', {"shape": "can"}),
    (SceneConfig, None, {"objects": (0, 3)}, {"objects": (5, 17)}, {"known": 1.5}, {"sides": (0.0, 0.1)}),
    (SceneConfig, None, {"noises": ()}, {"stacked": 1.5}, {"taper": (0.5, 1.2)}, {"wall": (0.0, 0.1)}, {"hollow": -1}),
    (Places, None, {"tables": 2.0}, {"distance": (0.0, 1.0)}, {"elevation": (0.1, 2.0)}),
    (Places, None, {"table": ((0.5, 0.4),) * 3}),
)


@pytest.mark.parametrize("row", IMPOSSIBLE, ids=lambda row: row[0].__name__)
def test_what_makes_no_sense_is_refused(row):
    made, words, *every = row
    for wrong in every:
        with pytest.raises(InputError, match=next(iter(wrong)) if words is None else words) as refused:
            made(**wrong)
        assert "\n" not in str(refused.value)


def test_pushes_of_nothing_are_refused():
    for wrong in ({"pushes": 0}, {"worlds": 0}, {"rounds": 0}, {"seed": -1}):
        with pytest.raises(InputError):
            Generation(**{"seed": 0, "pushes": 5, "worlds": 8, **wrong})
