"""Scenario files of version 2: bodies of several pieces and of meshes; what is wrong is refused with one line."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mechsearch_jax.runtime.errors import InputError, Note
from mechsearch_jax.workspace import scenario as scenarios
from mechsearch_jax.workspace.scenario import parse_compound

UPRIGHT = [1.0, 0.0, 0.0, 0.0]
QUARTER = [0.5**0.5, 0.0, 0.0, 0.5**0.5]
CYLINDER = {"shape": "cylinder", "half_size": [0.04, 0.04, 0.05], "position": [0, 0, 0.05], "quaternion": UPRIGHT}
HANDLE = {"shape": "box", "half_size": [0.015, 0.006, 0.03], "position": [0.05, 0, 0.05], "quaternion": UPRIGHT}
WEDGE = {
    "shape": "convex",
    "vertices": [[0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0, 0, 0.03]],
    "position": [0, 0, 0.1],
}
MUG = {
    "pieces": [CYLINDER, HANDLE],
    "density": 400.0,
    "friction": 0.5,
    "color": [0.2, 0.4, 0.6],
    "position": [0.6, 0.1, 0.41],
    "quaternion": QUARTER,
}
PLAIN = {"shape": "box", "half_size": [0.03, 0.02, 0.05], "position": [0.55, -0.1, 0.4545], "quaternion": UPRIGHT}
TARGET = {"shape": "cylinder", "half_size": [0.02, 0.02, 0.05], "position": [0.7, 0.1, 0.4545], "quaternion": UPRIGHT}


def scene(*objects, version=2, target=TARGET):
    return {
        "format": "mechsearch-scenario",
        "version": version,
        "name": "things",
        "objects": [json.loads(json.dumps(body)) for body in objects],
        "target": target,
    }


def test_a_compound_is_in_the_frame_of_its_centre_of_mass():
    body = scenarios.parse_scenario(scene(MUG, PLAIN), "file").objects[0]
    assert (body.shape, body.compound.density, body.compound.colour) == ("compound", 400.0, (0.2, 0.4, 0.6))
    turn = Rotation.from_quat(body.quaternion, scalar_first=True)
    for piece, given in zip(body.compound.pieces, MUG["pieces"], strict=True):
        in_world = turn.apply(piece.position) + body.position
        expected = Rotation.from_quat(QUARTER, scalar_first=True).apply(given["position"]) + MUG["position"]
        np.testing.assert_allclose(in_world, expected, atol=1e-7)
    assert (np.array(body.half_size) >= (0.04, 0.04, 0.05)).all()


@pytest.mark.parametrize("more", [[], [PLAIN]])
def test_what_is_written_is_read_back(tmp_path, more):
    start = scenarios.parse_scenario(scene(MUG, {**MUG, "pieces": [CYLINDER, WEDGE]}, *more), "file")
    scenarios.save_scenario(start, tmp_path / "scene.json")
    again = scenarios.load_scenario(tmp_path / "scene.json")
    assert again == start
    assert again.content_hash == start.content_hash
    assert json.loads((tmp_path / "scene.json").read_text())["version"] == 2


def test_what_needs_no_pieces_is_written_as_version_1():
    given = scenarios.parse_scenario(scene(PLAIN), "file")
    written = json.loads(scenarios.format_scenario(given))
    assert written == scene(PLAIN, version=1)
    assert given.content_hash == scenarios.parse_scenario(written, "file").content_hash


def test_the_content_hash_does_not_drift():
    assert scenarios.parse_scenario(scene(MUG, PLAIN), "file").content_hash == "b0293b2ada03"


def test_the_content_hash_is_of_all_that_a_body_is_made_of():
    start = scenarios.parse_scenario(scene(MUG), "file")
    hashes = {start.content_hash}
    (body,) = start.objects
    for change in (
        {"density": 401.0},
        {"friction": 0.6},
        {"colour": None},
        {"pieces": body.compound.pieces[::-1]},
        {"pieces": (dataclasses.replace(body.compound.pieces[0], shape="capsule"), body.compound.pieces[1])},
    ):
        compound = dataclasses.replace(body.compound, **change)
        changed = dataclasses.replace(start, objects=(dataclasses.replace(body, compound=compound),))
        hashes.add(changed.content_hash)
    assert len(hashes) == 6


def test_a_mesh_is_read_from_beside_the_scenario_and_written_as_pieces(tmp_path):
    boxes = [trimesh.creation.box((20, 30, 40)), trimesh.creation.box((10, 10, 90)).apply_translation((40, 0, 0))]
    trimesh.util.concatenate(boxes).export(tmp_path / "two.obj")
    body = {"mesh": "two.obj", "scale": 0.001, **{k: MUG[k] for k in ("density", "friction", "position", "quaternion")}}
    (tmp_path / "scene.json").write_text(json.dumps(scene(body)))
    start = scenarios.load_scenario(tmp_path / "scene.json")
    (made,) = start.objects
    assert [piece.shape for piece in made.compound.pieces] == ["convex"] * 2
    scenarios.save_scenario(start, tmp_path / "elsewhere" / "scene.json")
    assert scenarios.load_scenario(tmp_path / "elsewhere" / "scene.json") == start


def _set(value, path, new):
    for key in path[:-1]:
        value = value[key]
    value[path[-1]] = new


MESH = {k: v for k, v in MUG.items() if k not in ("pieces", "color")} | {"mesh": "none.obj"}


@pytest.mark.parametrize(
    ("path", "new", "message"),
    [
        (("version",), 1, 'objects[0]: bodies of pieces or meshes need "version": 2'),
        (("target",), {**MUG, "density": 0}, "target.density: 0 must be a number from 1 to 25000 kg/m3"),
        (("objects", 0, "mass"), 1.0, 'objects[0]: unknown key "mass"; known are pieces, density, friction'),
        (("objects", 0, "density"), "much", 'objects[0].density: "much" must be a number from 1 to 25000 kg/m3'),
        (("objects", 0, "friction"), -1, "objects[0].friction: -1 must be a number from 0 to 5"),
        (("objects", 0, "color"), [0, 0, 256], "objects[0].color: [0.0, 0.0, 256.0] must be red, green and blue"),
        (("objects", 0, "pieces"), [], "objects[0].pieces: must be a list of at least one piece"),
        (("objects", 0, "pieces"), [CYLINDER] * 17, "objects[0].pieces: 17 solids are too many, at most 16"),
        (("objects", 0, "pieces", 1), 3, "objects[0].pieces[1]: must be a JSON object with the keys shape"),
        (
            ("objects", 0, "pieces", 1, "shape"),
            "ball",
            'pieces[1].shape: "ball" is unknown; use box, cylinder, ellipsoid',
        ),
        (("objects", 0, "pieces", 1, "shape"), "capsule", "pieces[1].half_size: a capsule's first two"),
        (("objects", 0, "pieces", 1, "half_size"), [0.1, 0.1], "pieces[1].half_size: must be a list of 3 numbers"),
        (("objects", 0, "pieces", 1, "half_size"), [15, 6, 30], "must be lengths from 0.001 to 0.5 m"),
        (("objects", 0, "pieces", 1, "position"), [0, 0, 5], "pieces[1].position: [0.0, 0.0, 5.0] is farther than"),
        (("objects", 0, "pieces", 1, "quaternion"), [2, 0, 0, 0], "pieces[1].quaternion: its norm is 2; it must be 1"),
        (("objects", 0, "pieces", 1), {**WEDGE, "vertices": [[0, 0, 0]] * 3}, "vertices: must be a list of 4 to 48"),
        (("objects", 0, "pieces", 1), {**WEDGE, "vertices": [[0, 0, 0]] * 5}, "vertices: a piece is flat"),
        (("objects", 0, "position"), [0.3, 0.1, 0.45], "objects[0].position: x = 0.3 is off the board"),
        (("objects", 0), MESH, "none.obj cannot be read (No such file or directory); a path in a file counts from"),
        (("objects", 0), {**MESH, "mesh": 3}, "objects[0].mesh: 3 must be the path of a mesh file"),
        (
            ("objects", 0),
            {**MESH, "scale": 0},
            "objects[0].scale: 0 must be a number from 1e-06 to 1000 metres per unit",
        ),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path, path, new, message):
    value = scene(MUG)
    _set(value, path, new)
    file = tmp_path / "broken.json"
    file.write_text(json.dumps(value))
    with pytest.raises(InputError) as error:
        scenarios.load_scenario(file)
    assert str(error.value).startswith(f"{file}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_mesh_in_millimetres_is_noticed(tmp_path):
    trimesh.creation.box((200, 30, 40)).export(tmp_path / "none.obj")
    (tmp_path / "scene.json").write_text(json.dumps(scene(MESH)))
    with pytest.raises(InputError, match=r"200 m long, more than 1\.0; give its unit as scale, such as 0\.001"):
        scenarios.load_scenario(tmp_path / "scene.json")


def test_parts_of_a_mesh_that_are_too_small_are_named_as_the_cause(tmp_path):
    needle = trimesh.creation.box((0.003, 0.0001, 0.0001)).apply_translation((0.1, 0, 0))
    trimesh.util.concatenate([trimesh.creation.box((0.05, 0.05, 0.06)), needle]).export(tmp_path / "scan.stl")
    body = {"mesh": "scan.stl", "density": 500, "friction": 0.4}
    cause = "1 of its 2 loose parts have less than 1 mm3, the largest 150 cm3; delete the small ones"
    with pytest.warns(Note), pytest.raises(InputError, match=cause):
        parse_compound(body, (), "here", tmp_path)
