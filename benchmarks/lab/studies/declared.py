"""The studies that there are.

Ablations run on `development`, since they choose what the default has; all others on scenes that nothing was chosen on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.lab.studies.studies import Study, Variant
from mechsearch_jax.envs.simulators.named import EngineName
from mechsearch_jax.envs.world.mismatch import Mismatch

# Nothing was chosen on them; the second set was looked at before.
REPORT_SCENES, IMAGE_SCENES = "report-a", "report-b"
_VIEWS = Path(__file__).parents[1] / "parts" / "views"


def _in_worlds(worlds: Mapping[str, Mismatch], engine: EngineName | None = None, **options: Any) -> tuple[Variant, ...]:
    """A variant for each way in which the world is not as assumed."""
    return tuple(Variant(label, {**options, "mismatch": world}, engine=engine) for label, world in worlds.items())


def _by_factor(name: str, question: str, world: Callable[[float], Mismatch]) -> Study:
    """What if a property of the world, the study's name, is a multiple of what it is taken to be."""
    variants = tuple(
        Variant(f"{name} x {factor:g}", {"mismatch": world(factor)}) for factor in (1.0, 0.5, 0.7, 1.4, 2.0)
    )
    return Study(name, question, REPORT_SCENES, variants)


_USUAL_WORLD = {"as assumed": Mismatch()}
_CALIBRATION = {
    "camera off by 2 mm": Mismatch(camera_shift=0.002),
    "camera off by 5 mm": Mismatch(camera_shift=0.005),
    "camera off by 0.5°": Mismatch(camera_turn=0.5),
    "camera off by 1°": Mismatch(camera_turn=1.0),
    "shelf off by 2 mm": Mismatch(shelf_shift=0.002),
    "shelf off by 5 mm": Mismatch(shelf_shift=0.005),
    "shelf off by 0.5°": Mismatch(shelf_turn=0.5),
    "shelf off by 1°": Mismatch(shelf_turn=1.0),
}
_SENSOR = {
    "no depth noise": Mismatch(depth_noise=0.0),
    "2 mm of depth noise": Mismatch(depth_noise=0.002),
    "5 mm of depth noise": Mismatch(depth_noise=0.005),
    "10% of depth missing": Mismatch(missing_depth=0.1),
    "30% of depth missing": Mismatch(missing_depth=0.3),
}
_CAMERAS = ("camera-ahead", "camera-right", "camera-back")


def _shelf(name: str, question: str) -> Study:
    """What comes of another shelf, on scenes of its own."""
    file = _VIEWS / f"shelf-{name}.toml"
    return Study(
        f"shelf-{name}",
        question,
        f"shelf-{name}",
        (
            Variant("true shapes", config=file),
            Variant("masks", {"recognition": "masks"}, config=file),
            Variant("full", {"recognition": "full"}, config=file),
            Variant("preset paper", {"preset": "paper"}, config=file),
        ),
    )


_EACH_DRAWN = Mismatch(friction_spread=2.0, mass_spread=2.0)

ROBUSTNESS: tuple[Study, ...] = (
    _by_factor(
        "friction",
        "What if friction is not what trials assume?",
        lambda factor: Mismatch(friction=factor),
    ),
    _by_factor(
        "mass",
        "What if masses are not what trials assume?",
        lambda factor: Mismatch(mass=factor),
    ),
    Study(
        "friction-and-mass",
        "What if friction and mass of each body are drawn anew, from half to twice what trials assume?",
        IMAGE_SCENES,
        (
            Variant("as assumed"),
            *(
                Variant(f"drawn, {label}", {"trials": name, "mismatch": _EACH_DRAWN})
                for label, name in (("assumed", "physics"), ("no trials", "none"))
            ),
        ),
    ),
    Study(
        "calibration",
        "What if camera or shelf stand elsewhere than the planner takes them to be?",
        REPORT_SCENES,
        _in_worlds(_USUAL_WORLD | _CALIBRATION, recognition="masks"),
    ),
    Study(
        "sensor",
        "What if the depth image is noisier, or lacks pixels?",
        REPORT_SCENES,
        _in_worlds(_USUAL_WORLD | _SENSOR, recognition="masks"),
    ),
    Study(
        "cameras",
        "What if the camera is another, and the planner knows it?",
        REPORT_SCENES,
        (
            Variant("default camera", {"recognition": "masks"}),
            *(Variant(name, {"recognition": "masks"}, config=_VIEWS / f"{name}.toml") for name in _CAMERAS),
        ),
    ),
    _shelf("low", "What if the shelf is lower and closer?"),
    _shelf("narrow", "What if the shelf is higher and narrower?"),
    _shelf("wide", "What if the shelf is deeper and wider?"),
    Study(
        "physics",
        "What if the world's physics are not those of the trials? MuJoCo in C judges, and tries out.",
        REPORT_SCENES,
        (
            *_in_worlds(
                _USUAL_WORLD
                | {
                    "time step 2 ms": Mismatch(physics="fine-step"),
                    "time step 5 ms": Mismatch(physics="coarse-step"),
                    "softer contacts": Mismatch(physics="soft-contacts"),
                    "softer friction": Mismatch(physics="soft-friction"),
                    "pyramidal friction cone": Mismatch(physics="pyramidal-cone"),
                },
                engine="NativeSimulator",
            ),
            Variant("MJX with Warp", engine="MjxSimulator"),
        ),
    ),
)


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
        _values("horizon", (1, 2, 3, 4, 5)),
    ),
    Study(
        "sequences",
        "How many sequences should be sampled?",
        ABLATION_SCENES,
        (
            *_values("sequences", (100, 10, 30, 300, 1000)),
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
    "Baselines": _BASELINES,
    "Robustness": ROBUSTNESS,
}
STUDIES: Mapping[str, Study] = _by_name(*GROUPS.values())
