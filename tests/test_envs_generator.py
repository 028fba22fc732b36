"""Scenes: generated, published, and things that stand."""

import dataclasses
import functools
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from published import FOLDER as OURS
from scipy.spatial.transform import Rotation
from stage import stays_put

from mechsearch_jax.commands.main import parse
from mechsearch_jax.envs.camera import simulated_camera
from mechsearch_jax.envs.scenes import generator
from mechsearch_jax.envs.scenes.generator import GeneratorConfig, ScenarioGenerator, outline, separation
from mechsearch_jax.envs.scenes.published import published_files, read_published
from mechsearch_jax.envs.world import world
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.object_sizes import ObjectSizes
from mechsearch_jax.workspace.scenario import Body, format_scenario, load_scenario, parse_scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

SHELF = Shelf()
SIZES = {tuple(round(s / 2, 6) for s in box) for box in ObjectSizes().boxes}
SIZES |= {(b, a, c) for a, b, c in SIZES}
SIZES |= {(r, r, round(h / 2, 6)) for r, h in ObjectSizes().cylinders}


@pytest.fixture(scope="module", params=["cylinder", "box"])
def target(request):
    return Target.cylinder() if request.param == "cylinder" else Target.box()


@pytest.fixture(scope="module")
def made(target):
    return ScenarioGenerator(target)


@pytest.fixture(scope="module")
def allowed(target):
    poses = target.candidate_poses(SHELF)
    return poses[generator.graspable_alone(SHELF, target)]


def check(scene, objects, target, allowed):
    """Everything that a generated scenario promises."""
    state = world.from_scenario(scene)
    assert len(scene.objects) == objects
    assert all(tuple(round(s, 6) for s in b.half_size) in SIZES for b in scene.objects)
    assert scene.target.half_size == target.half_size
    assert int(simulated_camera.target_pixels(Camera(), state)) == 0

    yaw = 2 * np.arctan2(scene.target.quaternion[3], scene.target.quaternion[0])
    placed = np.array([*scene.target.position[:2], yaw])
    assert np.abs(allowed - placed).max(axis=1).min() < 1e-4

    at_rest(scene)


def at_rest(scene):
    """What every scenario promises that is made: nothing moves, falls or overlaps, and its file is good."""
    stays_put(scene)
    footprint = outline(scene.target)
    assert all(separation(footprint, outline(body)) > 0.001 for body in scene.objects)
    assert parse_scenario(json.loads(format_scenario(scene)), "made") == scene


# Two objects seldom hide a box: it takes seed 0 several hundred draws.
@pytest.mark.parametrize(("seed", "objects"), [(1, 2), (2, 4), (3, 6), (4, 8)])
def test_promises(made, target, allowed, seed, objects):
    check(made.generate(seed, objects), objects, target, allowed)


@pytest.fixture(scope="module")
def anywhere(target):
    return ScenarioGenerator(target, config=GeneratorConfig(anywhere=True, visible=100))


@pytest.fixture(scope="module")
def graspable(target):
    return generator.graspable_at(SHELF, target)


def test_targets_anywhere(anywhere, target, allowed, graspable):
    """Between the candidate poses, at any yaw, with up to 100 pixels in sight, and else as promised."""
    low, high = allowed[:, :2].min(axis=0), allowed[:, :2].max(axis=0)
    cell = np.array(target.cell(SHELF))
    offsets, yaws, pixels = [], [], []
    for seed in range(6):
        scene = anywhere.generate(seed, 4 + seed % 5)
        at_rest(scene)
        body = scene.target
        place, yaw = np.array(body.position[:2]), 2 * np.arctan2(body.quaternion[3], body.quaternion[0])
        assert body.position[2] == pytest.approx(target.height(SHELF), abs=1e-6)
        assert np.abs(body.quaternion[1:3]).max() == 0
        assert ((place > low - 1e-6) & (place < high + 1e-6)).all()
        assert graspable(np.array([*place, yaw]))
        nearest = np.abs((allowed[:, :2] - place) / cell[:2]).max(axis=1).argmin()
        offsets.append((allowed[nearest, :2] - place) / cell[:2])
        yaws.append(yaw)
        pixels.append(int(simulated_camera.target_pixels(Camera(), world.from_scenario(scene))))
    assert max(pixels) <= 100
    assert max(pixels) > 0
    assert np.ptp(offsets, axis=0).min() > 0.4
    assert np.abs(offsets).max() < 0.51
    if target.shape == "box":
        assert min(yaws) >= 0
        assert max(yaws) < np.pi
        assert np.ptp(yaws) > 1
        assert np.ptp([yaw % (np.pi / target.yaws) for yaw in yaws]) > 0.2
    else:
        assert yaws == [0.0] * 6


def test_what_is_graspable_alone_is_so_at_candidate_poses(target, allowed, graspable):
    poses = target.candidate_poses(SHELF)
    good = {tuple(pose) for pose in allowed}
    for pose in poses[:: len(poses) // 40]:
        assert graspable(pose) == (tuple(pose) in good), pose


def test_a_seed_means_one_scenario(made):
    first, other = made.generate(3, 4), made.generate(4, 4)
    assert ScenarioGenerator(made.target).generate(3, 4) == first
    assert first.name == "generated-4-3"
    assert first.objects != other.objects
    assert made.generate(3, 4, "mine") == dataclasses.replace(first, name="mine")


def test_what_cannot_be_generated_is_one_line(made):
    for seed, objects, message in ((0, 9, "objects: 9"), (0, 0, "objects: 0"), (-1, 4, "seed: -1 is negative")):
        with pytest.raises(InputError, match=message):
            made.generate(seed, objects)

    nowhere = functools.partial(ScenarioGenerator, graspable=lambda pose: False)
    with pytest.raises(InputError, match="the arm reaches it nowhere on the board"):
        nowhere(config=GeneratorConfig(attempts=2)).generate(0, 4)
    with pytest.raises(InputError, match="no graspable place is hidden in 2 scenes"):
        nowhere(config=GeneratorConfig(attempts=2, anywhere=True, target_placements=20)).generate(0, 4)


@pytest.mark.parametrize("wrong", [{"visible": -1}, {"gap": -0.1}, {"drift": 0.0}, {"attempts": 0}], ids=str)
def test_an_impossible_configuration_is_one_line(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        GeneratorConfig(**wrong)


def test_what_a_seed_means_does_not_drift(made):
    """The scenes that results and examples were made with."""
    hashes = {"cylinder": ("e2611a062532", "0cc21987952b"), "box": ("d10563c0d365", "13611d7bb0a3")}
    assert (made.generate(0, 4).content_hash, made.generate(3, 7).content_hash) == hashes[made.target.shape]


def test_separation_is_the_gap_between_outlines():
    box = Body("box", (0.03, 0.02, 0.05), (0.5, 0.0, 0.45), (1.0, 0.0, 0.0, 0.0))
    can = Body("cylinder", (0.02, 0.02, 0.05), (0.5, 0.1, 0.45), (1.0, 0.0, 0.0, 0.0))
    assert separation(outline(box), outline(can)) == pytest.approx(0.06, abs=2e-4)
    assert separation(outline(can), outline(box)) == pytest.approx(0.06, abs=2e-4)
    assert separation(outline(box), outline(dataclasses.replace(box, position=(0.55, 0.0, 0.5)))) < 0


def test_outlines_hold_the_body_at_any_pose():
    rng = np.random.default_rng(0)
    for shape in ("box", "cylinder"):
        half = np.array([0.03, 0.03 if shape == "cylinder" else 0.02, 0.06])
        turn = Rotation.random(random_state=rng)
        body = Body(shape, tuple(half), (0.6, 0.1, 0.5), tuple(turn.as_quat(scalar_first=True)))
        inside = rng.uniform(-1, 1, (2000, 3))
        if shape == "cylinder":
            inside = inside[np.hypot(inside[:, 0], inside[:, 1]) < 1]
        points = turn.apply(inside * half)[:, :2] + (0.6, 0.1)
        corners = outline(body)
        sides = np.roll(corners, -1, axis=0) - corners
        left = sides[:, 0] * (points[:, None, 1] - corners[:, 1]) - sides[:, 1] * (points[:, None, 0] - corners[:, 0])
        assert (left > -1e-9).all()


def body(shape, size, position, orientation=(0.0, 0.0, 0.0, 1.0)):
    return {
        "type": shape, "size": size, "position": position, "orientation": orientation,
        "object_color": (np.float64(0.1), 0.2, 0.3, 1.0),
    }  # fmt: skip


CYLINDER = body("cylinder", [np.float64(0.032), 0.032, 0.122], (0.6271400004, -0.055227, 0.46549), (0.0, 0.0, 1.0, 0.0))
BOX = body("box", [0.156, 0.044, 0.192], np.array([0.677852, -0.026518, 0.500489]))
TARGET = body("cylinder", [0.02, 0.02, 0.1], (0.738, -0.14043, 0.4545))


def write(folder, number, content, objects=2):
    file = folder / f"objects_{objects}" / f"initial_scenario_{number}.pkl"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(pickle.dumps(content))
    return file


def test_a_published_file_is_a_scenario(tmp_path):
    scenario = read_published(write(tmp_path, 7, [CYLINDER, BOX, TARGET]))
    assert scenario.name == "published-2-07"
    cylinder, box = scenario.objects
    assert (cylinder.shape, cylinder.half_size) == ("cylinder", (0.032, 0.032, 0.061))
    assert cylinder.position == (0.62714, -0.055227, 0.46549)
    # Their quaternions end with the real part, ours begin with it.
    assert cylinder.quaternion == (0.0, 0.0, 0.0, 1.0)
    assert (box.half_size, box.quaternion) == ((0.078, 0.022, 0.096), (1.0, 0.0, 0.0, 0.0))
    assert scenario.target.half_size == (0.02, 0.02, 0.05)


def test_the_command_makes_scenarios_of_all(tmp_path, capsys):
    for number in (10, 2):
        write(tmp_path / "exp_configs", number, [CYLINDER, BOX, TARGET])
    assert [file.name for file in published_files(tmp_path)] == ["initial_scenario_2.pkl", "initial_scenario_10.pkl"]
    parse(["scenarios", "import", str(tmp_path / "exp_configs"), "--out", str(tmp_path / "out")])()
    assert capsys.readouterr().out == f"2 scenarios: {tmp_path / 'out'}\n"
    assert load_scenario(tmp_path / "out" / "published-2-10.json").objects[1].shape == "box"


@pytest.mark.skipif(not OURS.is_dir(), reason="the published scenes are not there")
def test_it_is_what_results_ran_on(tmp_path):
    ours = load_scenario(OURS / "objects_2_00.json")
    bodies = []
    for each in (*ours.objects, ours.target):
        size = np.array(each.half_size) * (2.0 if each.shape == "box" else [1.0, 1.0, 2.0])
        w, *xyz = each.quaternion
        bodies.append(body(each.shape, size.tolist(), each.position, (*xyz, w)))
    again = read_published(write(tmp_path, 0, bodies))
    assert (again.name, again.content_hash) == (ours.name, ours.content_hash)


class Evil:
    def __reduce__(self):
        return Path.touch, (Path("evil"),)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ([Evil()], "neither a number nor an array"),
        ([CYLINDER, TARGET], "holds 2 bodies, not 2 objects and a target"),
        ([CYLINDER, BOX, {"type": "box"}], "none of the published scenes"),
        ([CYLINDER, BOX, {**TARGET, "type": "sphere"}], "neither box nor cylinder"),
        (3, "none of the published scenes"),
    ],
    ids=["code", "too few", "no size", "shape", "number"],
)
def test_what_is_no_published_scene_is_refused(content, reason, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path, 0, content)
    with pytest.raises(InputError, match=reason):
        read_published(file)
    assert not Path("evil").exists()
    with pytest.raises(InputError, match="objects_N/initial_scenario_K"):
        published_files(tmp_path / "nothing")
    file.rename(tmp_path / "scene.pkl")
    with pytest.raises(InputError, match="is not named"):
        read_published(tmp_path / "scene.pkl")
