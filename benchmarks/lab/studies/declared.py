"""The studies that there are.

Ablations run on `development`, since they choose what the default has; all others on scenes that nothing was chosen on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from mechsearch_jax.benchmarks.lab.studies.robustness import IMAGE_SCENES, REPORT_SCENES, ROBUSTNESS
from mechsearch_jax.benchmarks.lab.studies.studies import Study, Variant
from mechsearch_jax.envs.world.mismatch import Mismatch

ABLATION_SCENES = "development"
STANDARD = Variant("standard")
# Where policies to compare with are that no command has a name for.
POLICIES = "mechsearch_jax.benchmarks.policies"


def _degrees(*angles: int) -> tuple[float, ...]:
    return tuple(math.radians(angle) for angle in angles)


def _values(option: str, values: Sequence[int | float], **others: Any) -> tuple[Variant, ...]:
    """A variant for each value of an option of the planner, the default's first."""
    return tuple(Variant(f"{option} {value:g}", {option: value, **others}) for value in values)


_ABLATIONS = (
    Study(
        "gamma",
        "Does the discount of later actions matter?",
        ABLATION_SCENES,
        _values("gamma", (0.9, 0.5, 0.6, 0.7, 0.8, 1.0)),
    ),
    Study(
        "horizon",
        "How many actions ahead should be planned?",
        ABLATION_SCENES,
        _values("horizon", (3, 1, 2, 4, 5)),
    ),
    Study(
        "sequences",
        "How many sequences should be sampled?",
        ABLATION_SCENES,
        (
            *_values("sequences", (30, 10, 100, 300, 1000)),
            # 100 scenes.
            Variant("sequences 3000", {"sequences": 3000}, scenes=25),
        ),
    ),
    Study(
        "actions",
        "Which actions are needed?",
        ABLATION_SCENES,
        (
            STANDARD,
            Variant("pushes alone", {"actions": ("push",)}),
            Variant("pick-and-places alone", {"actions": ("pick-and-place",)}),
            Variant("the paper's actions", {"actions": ("paper",)}),
            Variant("no push straight in", {"push_directions": _degrees(90, -90, 35, -35, 65, -65)}),
            Variant("no push at 35°", {"push_directions": _degrees(90, -90, 0, 65, -65)}),
            Variant("no push at 65°", {"push_directions": _degrees(90, -90, 0, 35, -35)}),
            Variant("no push to the sides", {"push_directions": _degrees(0, 35, -35, 65, -65)}),
            Variant("no push of 5 cm", {"push_distances": (0.10, 0.15)}),
            Variant("no push of 10 cm", {"push_distances": (0.05, 0.15)}),
            Variant("no push of 15 cm", {"push_distances": (0.05, 0.10)}),
        ),
    ),
    Study(
        "extensions",
        "What does each extension of the paper gain, when it alone is left out?",
        ABLATION_SCENES,
        (
            STANDARD,
            Variant("no trials", {"trials": "none"}),
            Variant("collision-free grasps only", {"retrieval_contact": False}),
            Variant("a found target may be pushed", {"move_target": True}),
            Variant("preset paper", {"preset": "paper"}),
        ),
    ),
    Study(
        "push-model",
        "How well must pushes be predicted?",
        ABLATION_SCENES,
        (
            Variant("learned"),
            Variant("quasi-static", {"push_model": "quasi-static"}),
            Variant("learned, no trials", {"trials": "none"}),
            Variant("quasi-static, no trials", {"push_model": "quasi-static", "trials": "none"}),
        ),
    ),
    Study(
        "steps",
        "How much do twice as many actions gain?",
        ABLATION_SCENES,
        (Variant("10 actions"), Variant("20 actions", {"max_steps": 20})),
    ),
    Study(
        "recognition",
        "What does it cost to see images instead of true shapes?",
        ABLATION_SCENES,
        (
            Variant("oracle"),
            Variant("masks", {"recognition": "masks"}),
            Variant("full", {"recognition": "full"}),
            Variant("masks, no noise", {"recognition": "masks", "mismatch": Mismatch(depth_noise=0.0)}),
            Variant("masks, 2 mm", {"recognition": "masks", "mismatch": Mismatch(depth_noise=0.002)}),
            Variant("masks, 5 mm", {"recognition": "masks", "mismatch": Mismatch(depth_noise=0.005)}),
            Variant("full, 2 mm", {"recognition": "full", "mismatch": Mismatch(depth_noise=0.002)}),
            Variant("full, 5 mm", {"recognition": "full", "mismatch": Mismatch(depth_noise=0.005)}),
        ),
    ),
    Study(
        "friction-learned",
        "What does it gain to learn the friction while searching, where it is and is not as assumed?",
        ABLATION_SCENES,
        tuple(
            Variant(f"friction x {factor:g}, {label}", {"trials": name, "mismatch": Mismatch(friction=factor)})
            for factor in (1.0, 0.5, 1.4, 2.0)
            for label, name in (("assumed", "physics"), ("learned", "learning"))
        ),
    ),
)


_CONFIRMATIONS = (
    Study(
        "images",
        "What does it cost to see images instead of true shapes, on scenes that nothing was chosen on?",
        IMAGE_SCENES,
        (
            Variant("oracle"),
            Variant("masks", {"recognition": "masks"}),
            Variant("full", {"recognition": "full"}),
        ),
    ),
)

_BASELINES = (
    Study(
        "baselines",
        "How does search-for-grasp compare with other ways to decide?",
        REPORT_SCENES,
        (
            Variant("search-for-grasp"),
            Variant("search-and-grasp", policy="search-and-grasp"),
            Variant("random", policy="random"),
            Variant("greedy", policy="greedy"),
            Variant("most-occluding", policy=f"{POLICIES}.occlusion:most_occluding"),
            Variant("mctx", policy=f"{POLICIES}.tree_search:mctx"),
            Variant("preset paper", {"preset": "paper"}),
            Variant("no trials", {"trials": "none"}),
            Variant("10 sequences", {"sequences": 10}),
            Variant("300 sequences", {"sequences": 300}),
            Variant("informed", {"recognition": "informed"}),
            # With grasps that hit nothing, as the paper counts.
            Variant("collision-free", {"retrieval_contact": False}),
            Variant("informed, collision-free", {"recognition": "informed", "retrieval_contact": False}),
        ),
    ),
)


def _by_name(*groups: Sequence[Study]) -> dict[str, Study]:
    return {study.name: study for group in groups for study in group}


# By what they are for, in the order of the docs.
GROUPS: Mapping[str, Sequence[Study]] = {
    "Ablations": _ABLATIONS,
    "On new scenes": _CONFIRMATIONS,
    "Baselines": _BASELINES,
    "Robustness": ROBUSTNESS,
}
STUDIES: Mapping[str, Study] = _by_name(*GROUPS.values())
