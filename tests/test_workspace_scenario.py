"""Scenario files: what is read is what was written, and what is wrong is refused with one line."""

import copy
import dataclasses
import json
import stat

import numpy as np
import pytest
from published import published_scenarios

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace import scenario as scenarios
from mechsearch_jax.workspace.scenario import Body, Scenario

SCENE = Scenario(
    name="two-things",
    objects=(
        Body("box", (0.03, 0.012, 0.06), (0.6, 0.1, 0.4645), (0.0, 0.0, 0.0, 1.0)),
        Body("cylinder", (0.028, 0.028, 0.03), (0.55, -0.125, 0.4345), (1.0, 0.0, 0.0, 0.0)),
    ),
    target=Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.1, 0.4545), (1.0, 0.0, 0.0, 0.0)),
)

GOLDEN = """{
 "format": "mechsearch-scenario",
 "version": 1,
 "name": "one-thing",
 "objects": [
  {
   "shape": "box",
   "half_size": [
    0.03,
    0.012,
    0.06
   ],
   "position": [
    0.6,
    0.1,
    0.4645
   ],
   "quaternion": [
    0.0,
    0.0,
    0.0,
    1.0
   ]
  }
 ],
 "target": {
  "shape": "cylinder",
  "half_size": [
   0.02,
   0.02,
   0.05
  ],
  "position": [
   0.7,
   0.1,
   0.4545
  ],
  "quaternion": [
   1.0,
   0.0,
   0.0,
   0.0
  ]
 }
}
"""


def test_the_file_format_does_not_drift():
    scene = Scenario("one-thing", SCENE.objects[:1], SCENE.target)
    assert scenarios.format_scenario(scene) == GOLDEN
    assert scenarios.parse_scenario(json.loads(GOLDEN), "golden") == scene


def test_the_content_hash_does_not_drift():
    assert Scenario("one-thing", SCENE.objects[:1], SCENE.target).content_hash == "cb0dbb995539"


def test_the_content_hash_is_of_what_stands_where():
    hashes = {SCENE.content_hash}
    for change in (
        lambda b: dataclasses.replace(b, shape="cylinder" if b.shape == "box" else "box"),
        lambda b: dataclasses.replace(b, half_size=(*b.half_size[:2], b.half_size[2] + 1e-6)),
        lambda b: dataclasses.replace(b, position=(b.position[0], b.position[1] + 1e-6, b.position[2])),
        lambda b: dataclasses.replace(b, quaternion=(b.quaternion[0], 1e-9, *b.quaternion[2:])),
    ):
        hashes.add(dataclasses.replace(SCENE, objects=(change(SCENE.objects[0]), SCENE.objects[1])).content_hash)
        hashes.add(dataclasses.replace(SCENE, target=change(SCENE.target)).content_hash)
    hashes.add(dataclasses.replace(SCENE, objects=SCENE.objects[::-1]).content_hash)
    hashes.add(dataclasses.replace(SCENE, objects=SCENE.objects[:1]).content_hash)
    assert len(hashes) == 11
    assert all(len(h) == 12 for h in hashes)


def test_the_content_hash_is_not_of_name_or_writing(tmp_path):
    value = json.loads(scenarios.format_scenario(SCENE))
    value["name"] = "another"
    value["target"]["quaternion"] = [1, 0, -0.0, 0]
    (tmp_path / "tight.json").write_text(json.dumps(value, sort_keys=True))
    assert scenarios.load_scenario(tmp_path / "tight.json").content_hash == SCENE.content_hash


def test_what_is_written_is_read_back(tmp_path):
    scenarios.save_scenario(SCENE, tmp_path / "new" / "scene.json")
    assert scenarios.load_scenario(tmp_path / "new" / "scene.json") == SCENE
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["scene.json"]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "scene.json"
    scenarios.save_scenario(SCENE, path)
    before = path.read_text()
    broken = dataclasses.replace(SCENE.target, position=(float("nan"), 0.0, 0.0))
    with pytest.raises(ValueError):
        scenarios.save_scenario(dataclasses.replace(SCENE, target=broken), path)
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["scene.json"]


def test_an_unwritable_place_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        scenarios.save_scenario(SCENE, tmp_path / "file" / "scene.json")


def _set(value, path, new):
    for key in path[:-1]:
        value = value[key]
    value[path[-1]] = new


@pytest.mark.parametrize(
    ("path", "new", "message"),
    [
        (("format",), "other", 'format: "other" is not "mechsearch-scenario"'),
        (("version",), 3, "version: 3 is not supported; this program reads 1 and 2"),
        (("version",), True, "version: true is not supported"),
        (("name",), "", "name: must be a text"),
        (("colour",), "red", 'unknown key "colour"'),
        (("objects",), {}, "objects: must be a list"),
        (("objects", 0), 3, "objects[0]: must be a JSON object"),
        (("objects", 0, "mass"), 1.0, 'objects[0]: unknown key "mass"'),
        (("objects", 1, "shape"), "sphere", 'objects[1].shape: "sphere" is unknown; use "box" or "cylinder"'),
        (("objects", 1, "shape"), ["box"], 'objects[1].shape: ["box"] is unknown'),
        (("objects", 1, "half_size"), [0.02, 0.03, 0.05], "objects[1].half_size: a cylinder's first two"),
        (("target", "half_size"), [0.02, 0.02], "target.half_size: must be a list of 3 numbers"),
        (("target", "half_size"), [0.02, 0.02, 0.0], "target.half_size: [0.02, 0.02, 0.0] must be positive"),
        (("target", "position"), [0.7, True, 0.45], "target.position: must be a list of 3 numbers"),
        (("target", "position"), "here", "target.position: must be a list of 3 numbers"),
        (("target", "position"), [0.7, float("nan"), 0.45], "target.position: holds NaN or an infinite"),
        (("target", "position"), [0.3, 0.1, 0.45], "target.position: x = 0.3 is off the board"),
        (("target", "position"), [0.7, 0.1, 0.3], "target.position: z = 0.3 is off the board"),
        (("target", "quaternion"), [1.0, 1.0, 0.0, 0.0], "target.quaternion: its norm is 1.414; it must be 1"),
        (("target", "quaternion"), [0.0, 0.0, 0.0, 0.0], "target.quaternion: its norm is 0"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path, path, new, message):
    value = json.loads(scenarios.format_scenario(SCENE))
    _set(value, path, new)
    file = tmp_path / "broken.json"
    file.write_text(json.dumps(value))
    with pytest.raises(InputError) as error:
        scenarios.load_scenario(file)
    assert str(error.value).startswith(f"{file}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["format", "version", "name", "objects", "target"])
def test_a_missing_key_is_named(key):
    value = json.loads(GOLDEN)
    del value[key]
    with pytest.raises(InputError, match=f'file: key "{key}" is missing'):
        scenarios.parse_scenario(value, "file")


def test_more_objects_than_slots_are_refused():
    value = json.loads(GOLDEN)
    value["objects"] = [copy.deepcopy(value["objects"][0]) for _ in range(9)]
    with pytest.raises(InputError, match="objects: 9 are too many; at most 8 fit"):
        scenarios.parse_scenario(value, "file")


@pytest.mark.parametrize("text", [b"{", b"", b"\xff\xfe", b"[" * 100_000, b"[]", b"null"])
def test_a_file_that_is_no_scenario_is_one_line(tmp_path, text):
    file = tmp_path / "broken.json"
    file.write_bytes(text)
    with pytest.raises(InputError) as error:
        scenarios.load_scenario(file)
    assert str(error.value).startswith(f"{file}: ")
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_folder_are_one_line(tmp_path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            scenarios.load_scenario(path)


def test_bodies_become_superquadrics():
    scene = scenarios.superquadrics(SCENE.objects)
    assert scene.capacity == scenarios.MAX_OBJECTS
    np.testing.assert_array_equal(scene.valid, [True, True] + [False] * 6)
    np.testing.assert_allclose(scene.size[0], [0.03, 0.012, 0.06])
    np.testing.assert_allclose(scene.exponents[:2], [(0.2, 0.2), (0.2, 1.0)])
    np.testing.assert_allclose(scene.rotation[0], np.diag([-1.0, -1.0, 1.0]), atol=1e-7)
    assert not scenarios.superquadrics(()).valid.any()


def test_shipped_scenarios_are_well_formed():
    shipped = scenarios.example_scenarios()
    assert shipped
    for name, path in shipped.items():
        scene = scenarios.load_scenario(path)
        assert scene.name == name
        assert 4 <= len(scene.objects) <= 6
        assert path.read_text() == scenarios.format_scenario(scene)


def test_a_file_gets_ordinary_permissions(tmp_path):
    (tmp_path / "plain").write_text("")
    scenarios.save_scenario(SCENE, tmp_path / "new" / "scene.json")
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("plain", "new/scene.json")}
    assert len(modes) == 1
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["scene.json"]


@pytest.mark.skipif(not published_scenarios(), reason="the published scenes are not next to this checkout")
def test_published_scenes_are_read():
    files = published_scenarios()
    assert len(files) == 100
    assert sorted({len(scenarios.load_scenario(f).objects) for f in files}) == [2, 4, 6, 8]
