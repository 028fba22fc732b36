"""The studies that there are.

Ablations run on `development`, since they choose what the default has, and `extensions-full`, which chooses, too, on
scenes that were looked at before; all others on scenes that nothing was chosen on. Those of before a default changed
are around the former one: what is stored of them is of it, and so is what runs again.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.statistics.settings import FORMER_STANDARDS
from mechsearch_jax.benchmarks.studies.studies import Study, Variant
from mechsearch_jax.envs.simulators.named import EngineName
from mechsearch_jax.envs.world.mismatch import Mismatch

ABLATION_SCENES, REPORT_SCENES = "development", "report-a"
# A set for each later question, since a set that was looked at is no longer unseen.
IMAGE_SCENES, CONFIRMATION_SCENES, DEFAULT_SCENES = "report-b", "report-c", "report-d"
_VIEWS = Path(__file__).parents[1] / "parts" / "views"
STANDARD = Variant("standard")


def _degrees(*angles: int) -> tuple[float, ...]:
    return tuple(math.radians(angle) for angle in angles)


def _values(option: str, values: Sequence[int | float], **others: Any) -> tuple[Variant, ...]:
    """A variant for each value of an option of the planner, the default's first."""
    return tuple(Variant(f"{option} {value:g}", {option: value, **others}, value=float(value)) for value in values)


def _in_worlds(worlds: Mapping[str, Mismatch], engine: EngineName | None = None, **options: Any) -> tuple[Variant, ...]:
    """A variant for each way in which the world is not as assumed."""
    return tuple(Variant(label, {**options, "mismatch": world}, engine=engine) for label, world in worlds.items())


def _factors(label: str, world: Callable[[float], Mismatch], **options: Any) -> tuple[Variant, ...]:
    """A variant for each factor on a property of the world, 1 first."""
    return tuple(
        Variant(
            f"{label} x {factor:g}",
            {**options, "mismatch": world(factor)},
            value=factor,
        )
        for factor in (1.0, 0.5, 0.7, 1.4, 2.0)
    )


_ABLATIONS = (
    Study(
        "gamma",
        "Does the discount of later actions matter?",
        ABLATION_SCENES,
        _values("gamma", (0.9, 0.5, 0.6, 0.7, 0.8, 1.0)),
        axis="gamma",
    ),
    Study(
        "horizon",
        "How many actions ahead should be planned?",
        ABLATION_SCENES,
        _values("horizon", (3, 1, 2, 4, 5)),
        axis="actions in a sequence, M",
    ),
    Study(
        "sequences",
        "How many sequences should be sampled?",
        ABLATION_SCENES,
        (
            *_values("sequences", (30, 10, 100, 300, 1000)),
            # 100 scenes.
            Variant("sequences 3000", {"sequences": 3000}, value=3000.0, scenes=25),
        ),
        axis="sequences",
        logarithmic=True,
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
            Variant("objects grasped at 20° only", {"object_grasp_tilts": _degrees(20)}),
        ),
    ),
    Study(
        "extensions",
        "What does each extension of the paper gain, when it alone is left out?",
        ABLATION_SCENES,
        (
            STANDARD,
            Variant("no trials", {"rehearsal": "none"}),
            Variant("collision-free grasps only", {"retrieval_contact": False}),
            Variant("no penalty of unseen contact", {"unseen_contact_penalty": 0.0}),
            Variant("even draws", {"guided_fraction": 0.0}),
            Variant("no weight of crowding", {"crowding_weight": 0.0}),
            Variant("one draw of the first action", {"first_draws": 1}),
            Variant("objects may move again", {"move_again": True}),
            Variant("a found target stays", {"move_target": False}),
            Variant("collisions in predictions", {"predicted_collisions": True}),
            Variant("unseen space not avoided", {"avoid_unseen": False}),
            Variant("no margin of a cell", {"cell_reach": (0.5,)}),
            Variant("no closer look", {"closer_look": 0}),
            Variant("no erosion", {"erosion": 0.0}),
            Variant("f never reopened", {"reopen": False}),
            Variant("g at 20° only", {"grasp_tilts": _degrees(20)}),
            Variant("found target at 20° only", {"retrieval_tilts": _degrees(20)}),
            Variant("f by mean squared depth", {"criterion": "depth-mse"}),
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
            Variant("learned, no trials", {"rehearsal": "none"}),
            Variant("quasi-static, no trials", {"push_model": "quasi-static", "rehearsal": "none"}),
        ),
    ),
    Study(
        "steps",
        "How much do twice as many actions gain?",
        ABLATION_SCENES,
        (Variant("10 actions"), Variant("20 actions", {"max_steps": 20}), Variant("best", {"preset": "best"})),
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
            Variant(f"friction x {factor:g}, {label}", {"rehearsal": name, "mismatch": Mismatch(friction=factor)})
            for factor in (1.0, 0.5, 1.4, 2.0)
            for label, name in (("assumed", "physics"), ("learned", "learning"))
        ),
    ),
)

# What gained nothing on `development`, each by itself, and could be left out of the default.
_LEFT_OUT = {"reopen": False, "closer_look": 0, "erosion": 0.0, "cell_reach": (0.5,), "move_target": False}

# What may take the default's place: it looks one action ahead, and leaves two extensions out.
_THREE_AHEAD = {"horizon": 3, "sequences": 30, "move_target": True, "erosion": 0.001}
_ONE_AHEAD = {"horizon": 1, "sequences": 300, "move_target": False, "erosion": 0.0}
_FULL = {"recognition": "full"}

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
    Study(
        "confirmation",
        "Which differences of the ablations hold on scenes that nothing was chosen on?",
        CONFIRMATION_SCENES,
        (
            STANDARD,
            Variant("20 actions", {"max_steps": 20}),
            Variant("horizon 1", {"horizon": 1}),
            Variant("horizon 1, 300 sequences", {"horizon": 1, "sequences": 300}),
            Variant("gamma 0.5", {"gamma": 0.5}),
            Variant("300 sequences", {"sequences": 300}),
            Variant("f never reopened", {"reopen": False}),
            Variant("what gained nothing left out", _LEFT_OUT),
            Variant("full", {"recognition": "full"}),
            Variant("full, what gained nothing left out", {"recognition": "full", **_LEFT_OUT}),
        ),
    ),
    Study(
        "extensions-full",
        "What does each extension gain through images, when it alone is left out?",
        CONFIRMATION_SCENES,
        (
            Variant("full", _FULL),
            Variant("collision-free grasps only", {**_FULL, "retrieval_contact": False}),
            Variant("a found target stays", {**_FULL, "move_target": False}),
            Variant("no margin of a cell", {**_FULL, "cell_reach": (0.5,)}),
            Variant("no erosion", {**_FULL, "erosion": 0.0}),
            Variant("f never reopened", {**_FULL, "reopen": False}),
            Variant("one ahead, 300 sequences", {**_FULL, "horizon": 1, "sequences": 300}),
        ),
        chooses=True,
    ),
    Study(
        "one-ahead",
        "Is it as good to look one action ahead, with more of them, and to leave out what gained nothing?",
        DEFAULT_SCENES,
        (
            Variant("three ahead, full", {**_FULL, **_THREE_AHEAD}),
            Variant("one ahead, full", {**_FULL, **_ONE_AHEAD}),
            Variant("three ahead, true shapes", _THREE_AHEAD),
            Variant("one ahead, true shapes", _ONE_AHEAD),
        ),
    ),
)

# Around today's default.
_DEFAULT = (
    Study(
        "first-actions",
        "How many first actions are worth comparing, and how far ahead, where the eight that are tried differ?",
        DEFAULT_SCENES,
        (
            Variant("100, full", _FULL),
            Variant("300, full", {**_FULL, "sequences": 300}),
            Variant("30 of three actions, full", {**_FULL, **_THREE_AHEAD}),
            Variant("100, true shapes"),
            Variant("300, true shapes", {"sequences": 300}),
            Variant("30 of three actions, true shapes", _THREE_AHEAD),
        ),
        chooses=True,
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
            Variant("most-occluding", policy="most-occluding"),
            Variant("mctx", policy="mctx"),
            Variant("preset paper", {"preset": "paper"}),
            Variant("preset published-code", {"preset": "published-code"}),
            Variant("no trials", {"rehearsal": "none"}),
            Variant("10 sequences", {"sequences": 10}),
            Variant("300 sequences", {"sequences": 300}),
            Variant("informed", {"recognition": "informed"}),
            # With grasps that hit nothing, as the paper counts.
            Variant("collision-free", {"retrieval_contact": False}),
            Variant("informed, collision-free", {"recognition": "informed", "retrieval_contact": False}),
        ),
        by_time=True,
    ),
)

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

_ROBUSTNESS = (
    Study(
        "friction",
        "What if friction is not what trials assume?",
        REPORT_SCENES,
        _factors("friction", lambda factor: Mismatch(friction=factor)),
        axis="true friction as a multiple of what trials assume",
        logarithmic=True,
    ),
    Study(
        "friction-without-trials",
        "What if friction is not as usual, and nothing is tried out?",
        REPORT_SCENES,
        _factors("friction", lambda factor: Mismatch(friction=factor), rehearsal="none"),
        axis="true friction as a multiple of the usual",
        logarithmic=True,
    ),
    Study(
        "mass",
        "What if masses are not what trials assume?",
        REPORT_SCENES,
        _factors("mass", lambda factor: Mismatch(mass=factor)),
        axis="true masses as a multiple of what trials assume",
        logarithmic=True,
    ),
    Study(
        "friction-and-mass",
        "What if friction and mass of each body are drawn anew, from half to twice what trials assume?",
        IMAGE_SCENES,
        (
            Variant("as assumed"),
            *(
                Variant(f"drawn, {label}", {"rehearsal": name, "mismatch": _EACH_DRAWN})
                for label, name in (("assumed", "physics"), ("learned", "learning"), ("no trials", "none"))
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


def _around(former: str, studies: Sequence[Study]) -> tuple[Study, ...]:
    """Studies around a former default, of which presets `standard` and `best` were made."""
    before = FORMER_STANDARDS[former]

    def own(variant: Variant) -> Variant:
        made_of_it = variant.options.get("preset", "standard") in ("standard", "best")
        return dataclasses.replace(variant, options={**(before if made_of_it else {}), **variant.options})

    return tuple(dataclasses.replace(s, variants=tuple(map(own, s.variants)), around=former) for s in studies)


_FORMER = "standard until 2026-11-26"


def _by_name(*groups: Sequence[Study]) -> dict[str, Study]:
    return {study.name: study for group in groups for study in group}


# By what they are for, in the order of the page.
GROUPS: Mapping[str, Sequence[Study]] = {
    "Ablations": _around(_FORMER, _ABLATIONS),
    "On new scenes": (*_around(_FORMER, _CONFIRMATIONS), *_DEFAULT),
    "Baselines": _around(_FORMER, _BASELINES),
    "Robustness": _around(_FORMER, _ROBUSTNESS),
}
STUDIES: Mapping[str, Study] = _by_name(*GROUPS.values())
