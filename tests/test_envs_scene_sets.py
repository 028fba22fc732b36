"""Named scene sets: what they hold is on record, a scene depends on its seed alone, files hold what is on record."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
from stage import stays_put

from mechsearch_jax.envs.camera import simulated_camera
from mechsearch_jax.envs.scenes import scene_sets
from mechsearch_jax.envs.scenes.generator import outline, separation
from mechsearch_jax.envs.scenes.scene_sets import SETS, Block, make_scene, recorded, scene_files
from mechsearch_jax.envs.scenes.three_objects import LineConfig
from mechsearch_jax.envs.world import world
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime import kept_arrays
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario, load_scenario

# Those that are not a part of another.
SHELVES = ("shelf-low", "shelf-narrow", "shelf-wide")
HOUSEHOLD = ("household", "household-box", "report-household")
WHOLE = ("c2", "d1", "d2", "d3", "development", "development-box", "report", *SHELVES, *HOUSEHOLD)
BLOCKS = [block for name in WHOLE for block in SETS[name].blocks]
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def pixels(scene):
    return int(simulated_camera.target_pixels(Camera(), world.from_scenario(scene)))


def test_the_sets_are_those_of_the_paper():
    blocks = {name: [(b.objects, b.scenes, b.target) for b in SETS[name].blocks] for name in WHOLE}
    assert blocks["c2"] == [(n, 180, "cylinder") for n in (2, 4, 6, 8)]
    assert blocks["d1"] == [(2, 200, "cylinder")]
    assert blocks["d2"] == [(n, 75, "cylinder") for n in (4, 8)]
    assert blocks["d3"] == [(n, 40, "box") for n in (4, 8)]
    assert [SETS[name].scenes for name in ("c2", "c2-6", "d2", "d3-8", "report")] == [720, 180, 150, 40, 400]
    assert {"c2-2", "c2-8", "d2-4", "d3-4", "development-4", "development-box-8"} < set(SETS)


def test_scenes_that_settings_were_chosen_on_are_known_by_name():
    chosen = {b.name: sum(scene_sets.is_chosen_on(b.scene_name(i)) for i in range(b.scenes)) for b in BLOCKS}
    whole = {b.name: b.scenes for b in BLOCKS if b.name.startswith("development")}
    assert {name: count for name, count in chosen.items() if count} == {
        **whole,
        **{f"c2-{n}": 90 for n in (2, 4, 6, 8)},
    }
    assert scene_sets.is_chosen_on("published-8-24")
    assert not scene_sets.is_chosen_on("first-light")


def test_no_two_experiments_share_a_seed():
    seeds = {name: {b.first_seed + i for b in SETS[name].blocks for i in range(b.scenes)} for name in WHOLE}
    for one, other in itertools.combinations(WHOLE, 2):
        assert not seeds[one] & seeds[other], (one, other)
    # What examples, tests and timings take.
    assert min(min(each) for each in seeds.values()) >= 1000


def test_every_scene_is_on_record_and_no_two_are_alike():
    assert {name: len(hashes) for name, hashes in recorded().items()} == {b.name: b.scenes for b in BLOCKS}
    hashes = [content for each in recorded().values() for content in each]
    assert len(set(hashes)) == len(hashes) == 3290
    assert all(re.fullmatch("[0-9a-f]{12}", content) for content in hashes)


def test_digests_do_not_drift():
    assert {name: scene_sets.digest(SETS[name]) for name in WHOLE} == DIGESTS


DIGESTS = {
    "c2": "87d316443d3b",
    "d1": "f9a03a5d69d2",
    "d2": "c3ec98190e98",
    "d3": "c533bcf7ecfa",
    "development": "3af2a9ae9f30",
    "development-box": "1bc8aba34a0e",
    "report": "2fff8256486c",
    "report-household": "73175a8a4a35",
    "shelf-low": "f547905348d9",
    "shelf-narrow": "aaa051492858",
    "shelf-wide": "32c83e4f2af2",
    "household": "1aed359436e1",
    "household-box": "39016ed60239",
}


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.name)
def test_a_scene_of_each_block_is_what_is_on_record(block):
    """Fails where the generator changed; `scene_sets.record` is for changes that are meant to change the sets."""
    # None of these takes the generator more than a second.
    index = block.scenes // 4
    scene = make_scene(block, index)
    assert scene_sets.is_recorded(block, index, scene), scene.name
    assert (scene.name, len(scene.objects), scene.target.shape) == (
        f"{block.name}-{index:03d}", block.objects, block.target,
    )  # fmt: skip
    assert pixels(scene) <= 100


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.name)
def test_all_scenes_are_what_is_on_record(block):
    made = [make_scene(block, index).content_hash for index in range(block.scenes)]
    assert made == recorded()[block.name]


def test_two_cylinders_in_line_hide_the_target_each_by_itself():
    camera, gripper = Camera(), Gripper()
    sizes = []
    for index in range(0, 200, 20):
        scene = make_scene(SETS["d1"].blocks[0], index)
        assert scene.target.position[:2] == LineConfig().target
        assert scene.target.half_size == (0.02, 0.02, 0.05)
        eye = np.array(camera.position[:2])
        places = np.array([body.position[:2] for body in (*scene.objects, scene.target)]) - eye
        cross = places[:, 0] * places[2, 1] - places[:, 1] * places[2, 0]
        assert np.abs(cross).max() < 1e-5
        assert (np.diff(np.linalg.norm(places, axis=1)) > 0).all()
        for body in scene.objects:
            assert body.shape == "cylinder"
            assert 2 * body.half_size[0] <= gripper.usable_opening
            assert body.half_size[0] > scene.target.half_size[0]
            assert pixels(dataclasses.replace(scene, objects=(body,))) <= 100
        bodies = (*scene.objects, scene.target)
        assert all(separation(outline(a), outline(b)) > 0.003 for a, b in itertools.combinations(bodies, 2))
        stays_put(scene)
        sizes += [(body.half_size[0], body.half_size[2]) for body in scene.objects]
    assert np.ptp(sizes, axis=0) == pytest.approx([0.01, 0.045], rel=0.4)


@pytest.fixture
def quick(monkeypatch):
    """A block whose scenes cost nothing, and the numbers of those that were made."""
    block, made = Block("quick", 4, 0, "cylinder", 1000), []

    def make(block, index):
        made.append(index)
        where = (0.6, 0.01 * index, 0.4545)
        return Scenario(block.scene_name(index), (), Body("cylinder", (0.02, 0.02, 0.05), where, UPRIGHT))

    record = {"quick": [make(block, index).content_hash for index in range(4)]}
    monkeypatch.setattr(scene_sets, "make_scene", make)
    monkeypatch.setattr(scene_sets, "recorded", lambda: record)
    made.clear()
    return block, made, record["quick"]


def test_files_are_made_once_and_hold_what_is_on_record(tmp_path, monkeypatch, quick):
    block, made, record = quick
    monkeypatch.setenv(kept_arrays.VARIABLE, str(tmp_path / "cache"))
    progressed = []

    def progress(missing):
        progressed.append(len(missing))
        return iter(missing)

    two = scene_files([(block, 2), (block, 0)], progress=progress)
    assert [file.name for file in two.files] == ["quick-002.json", "quick-000.json"]
    assert [load_scenario(file).content_hash for file in two.files] == [record[2], record[0]]
    everything = scene_files([(block, i) for i in range(4)], progress=progress)
    assert made == [2, 0, 1, 3]
    assert progressed == [2, 2]
    assert all(tmp_path / "cache" in file.parents for file in everything.files)
    assert everything.strange == []
    # What was damaged, edited or is another scene is made anew.
    everything.files[0].write_text("{")
    text = everything.files[1].read_text()
    everything.files[1].write_text(text.replace("0.02", "0.03"))
    everything.files[2].write_text(text)
    again = scene_files([(block, i) for i in range(4)], progress=progress)
    assert made[4:] == [0, 1, 2]
    assert [load_scenario(file).content_hash for file in again.files] == record
    assert scene_files([(block, 1)], tmp_path / "mine").files == [tmp_path / "mine" / "quick-001.json"]


def test_scenes_that_are_not_what_is_on_record_are_reported(tmp_path, quick):
    block, _, record = quick
    record[1] = "0123456789ab"
    files = scene_files([(block, i) for i in range(4)], tmp_path)
    assert files.strange == ["quick-001"]
    assert len(files.files) == 4
