"""Recordings, how they are played, and films of them."""

import dataclasses
import itertools
import types

import av
import jax
import numpy as np
import pytest
from PIL import Image
from recordings import MOVES, RECORDING, SAMPLED, SEQUENCES, WORLD

from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.recording import film as film_module
from mechsearch_jax.envs.recording.film import Film
from mechsearch_jax.envs.recording.pictures import recorded_frame
from mechsearch_jax.envs.recording.playback import ENDS, LOOKS, Playback, playback
from mechsearch_jax.envs.recording.recording import (
    NAME,
    Recorder,
    load_recording,
    save_recording,
)
from mechsearch_jax.envs.simulators.trace import Trace
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.geometry.bodies import with_parts
from mechsearch_jax.robot.arm_config import PANDA
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.viz.movie import save_movie


def of_parts(step):
    scenes = {name: jax.tree.map(np.asarray, with_parts(getattr(step, name))) for name in ("scene", "after")}
    return dataclasses.replace(step, **scenes)


OF_PARTS = dataclasses.replace(RECORDING, steps=tuple(map(of_parts, RECORDING.steps)))


@pytest.fixture(scope="module")
def played():
    return playback(RECORDING, 25)


@pytest.mark.parametrize("recording", [RECORDING, OF_PARTS], ids=["bodies", "bodies of parts"])
def test_a_recording_comes_back_as_it_was_written(recording, tmp_path):
    save_recording(recording, tmp_path / NAME)
    assert (tmp_path / NAME).stat().st_size < 30_000
    again = load_recording(tmp_path / NAME)
    for name in ("heading", "camera", "shelf", "target"):
        assert getattr(again, name) == getattr(recording, name)
    for one, other in zip(again.steps, recording.steps, strict=True):
        assert (one.title, one.caption, one.found) == (other.title, other.caption, other.found)
        assert (one.action is None) == (other.action is None)
        for name in ("world", "scene", "after", "existence", "graspability", "target_pose", "action"):
            jax.tree.map(np.testing.assert_array_equal, getattr(one, name), getattr(other, name))
        jax.tree.map(np.testing.assert_array_equal, one.sampled.action, other.sampled.action)
        for name in ("value", "cost", "position", "rotation"):
            np.testing.assert_allclose(getattr(one.sampled, name), getattr(other.sampled, name), atol=1e-6)
        for field in dataclasses.fields(Trace):
            ours, theirs = getattr(one.trace, field.name), getattr(other.trace, field.name)
            np.testing.assert_allclose(ours, theirs, atol=1e-6)
            assert ours.shape == theirs.shape


def cut(arrays):
    arrays["trace.q"] = arrays["trace.q"][:-1]


def forget(arrays):
    del arrays["world.kind"]


def lose(arrays):
    arrays["trace.q"] = arrays["trace.q"] * np.nan


def misname_samples(arrays):
    arrays["sampled.action.kind"] = arrays["sampled.action.kind"] + 90


@pytest.mark.parametrize("spoil", [misname_samples, cut, forget, lose])
def test_what_is_no_recording_is_refused_in_one_line(spoil, tmp_path):
    save_recording(RECORDING, tmp_path / NAME)
    with np.load(tmp_path / NAME) as file:
        arrays = dict(file)
    spoil(arrays)
    np.savez(tmp_path / NAME, **arrays)
    with pytest.raises(InputError, match=f"{NAME}: is no recording of an episode") as refused:
        load_recording(tmp_path / NAME)
    assert "\n" not in str(refused.value)
    (tmp_path / NAME).write_bytes(b"PK")
    with pytest.raises(InputError, match="is no whole archive"):
        load_recording(tmp_path / NAME)


def test_a_recorder_keeps_what_was_shown_and_what_moved():
    one, two, _ = RECORDING.steps
    simulator = types.SimpleNamespace(traces=[one.trace])
    recorder = Recorder(simulator)
    problem = types.SimpleNamespace(camera=RECORDING.camera, shelf=RECORDING.shelf, target=RECORDING.target)
    for recorded in (one, two):
        frame = recorded_frame(recorded, RECORDING.camera, RECORDING.shelf)
        decision = (
            None if recorded.action is None else types.SimpleNamespace(action=recorded.action, sequences=SEQUENCES)
        )
        outcome = None if recorded.action is None else object()
        snapshot = types.SimpleNamespace(world=recorded.world)
        recorder.note.__wrapped__(
            recorder, types.SimpleNamespace(snapshot=snapshot, decision=decision, outcome=outcome), frame
        )
    kept = recorder.recording.__wrapped__(recorder, problem, "how it ended")
    assert [s.title for s in kept.steps] == ["1  push", "2  no action"]
    assert kept.steps[0].trace is one.trace
    np.testing.assert_array_equal(kept.steps[0].sampled.after(1, recorded.scene).position, SAMPLED.position[1])
    assert kept.steps[0].sampled.value.tolist() == [-30.0, -10.0]
    assert kept.steps[0].sampled.cost.tolist() == [90.0, 95.0]
    np.testing.assert_array_equal(kept.steps[0].sampled.single(1).displacement, SAMPLED.action.displacement[1])
    assert len(kept.steps[1].sampled) == 0
    assert kept.steps[1].action is None
    assert len(kept.steps[1].trace.time) == 0
    assert kept.heading == "how it ended"


def test_everything_that_was_simulated_is_played_at_its_pace(played):
    first = played.step == 0
    pushed = played.position[first, 0, 1] - WORLD.position[0, 1]
    assert pushed[0] == 0.0
    assert pushed[-1] == pytest.approx(0.1)
    moving = played.time[first][(pushed > 1e-4) & (pushed < 0.0999)]
    assert moving[-1] - moving[0] == pytest.approx(MOVES, abs=0.1)
    assert (np.diff(pushed) > -1e-9).all()
    np.testing.assert_allclose(played.position[:, TARGET], np.tile(WORLD.position[TARGET], (len(played.step), 1)))


def test_the_arm_goes_where_it_was_set_and_nothing_faster_than_it_can(played):
    assert (np.diff(played.step) >= 0).all()
    turned = np.abs(np.diff(played.q, axis=0)) * 25
    together = np.diff(played.step) == 0
    assert (turned[together] < 1.01 * np.array(PANDA.velocity)).all()
    for i in (0, 1):
        np.testing.assert_allclose(played.q[played.step == i][[0, -1]], [HOME, HOME], atol=1e-4)
    # A retrieval ends where the hand holds the target.
    np.testing.assert_allclose(played.q[-1], RECORDING.steps[2].trace.q[-1], atol=1e-6)
    assert played.opening.min() >= 0.0
    assert played.opening.max() == pytest.approx(0.02)


def test_a_step_in_which_nothing_moves_is_shown_all_the_same(played):
    lasts = (played.step == 1).sum() / 25
    assert lasts == pytest.approx(LOOKS, abs=0.05)
    resting = (np.abs(played.q[played.step == 2] - played.q[-1]).max(axis=1) < 1e-6).sum() / 25
    assert resting == pytest.approx(ENDS, abs=0.1)


def test_a_film_shows_the_robot_the_map_and_what_the_camera_saw(tmp_path):
    film = Film(RECORDING, 320, 1)
    images = list(film)
    assert len(images) == film.count > 6
    width, height = film.size
    assert width == 320
    assert height % 2 == 0
    assert {image.shape for image in images} == {(height, width, 3)}
    left, right = (slice(None), slice(10, 190)), (slice(height // 8, height // 2), slice(200, None))
    for part in (left, right):
        changes = [np.abs(a[part].astype(int) - b[part]).max() for a, b in itertools.pairwise(images)]
        assert max(changes) > 60
    # White light grey: the arm.
    assert (images[0][left].min(axis=-1) > 200).mean() > 0.1


FADING = [np.full((32, 48, 3), shade, np.uint8) for shade in range(20, 240, 20)]


def test_a_robot_that_stands_still_is_drawn_once_and_shown_as_often(played, monkeypatch):
    still = [row for row in range(len(played.time)) if played.is_still(row)]
    assert not played.is_still(0)
    assert 1 in still
    moves = np.flatnonzero(np.any(np.diff(played.q, axis=0), axis=1)) + 1
    assert not set(moves.tolist()) & set(still)
    assert len(still) > 10
    film = Film(RECORDING, 320, 5)
    shown = list(film)
    monkeypatch.setattr(Playback, "is_still", lambda self, row: False)
    assert all(np.array_equal(a, b) for a, b in zip(shown, film, strict=True))


def test_several_processes_draw_the_same_pictures_in_order(monkeypatch):
    alone = list(Film(RECORDING, 320, 3))
    monkeypatch.setattr(film_module, "EACH", 1)
    monkeypatch.setattr(film_module, "LOT", 2)
    monkeypatch.setattr(film_module, "cores", lambda: 2)
    assert all(np.array_equal(a, b) for a, b in zip(alone, Film(RECORDING, 320, 3), strict=True))


def test_a_movie_is_what_its_ending_says(tmp_path):
    save_movie(iter(FADING), tmp_path / "film.mp4", 5)
    with av.open(tmp_path / "film.mp4") as container:
        (stream,) = container.streams
        shades = [frame.to_ndarray(format="rgb24").mean() for frame in container.decode(stream)]
        assert (stream.width, stream.height, stream.average_rate) == (48, 32, 5)
    np.testing.assert_allclose(shades, range(20, 240, 20), atol=4)
    save_movie(iter(FADING), tmp_path / "film.webp", 5)
    with Image.open(tmp_path / "film.webp") as picture:
        assert (picture.format, picture.size, picture.n_frames) == ("WEBP", (48, 32), len(FADING))
        picture.seek(3)
        assert np.asarray(picture.convert("RGB")).mean() == pytest.approx(80, abs=4)
        assert picture.info["duration"] == 200


WRONG = {
    "no recording": (["video", "."], "recording.npz: there is none; search once more with --record"),
    "ending": (["video", ".", "--out", "film.avi"], "film.avi: ends in none of .mp4, .webp"),
    "width": (["video", ".", "--width", "10"], "--width 10 is not between 320 and 3840"),
    "ending of a search": (["search", "first-light", "--out", "new", "--video", "film.gif"], "film.gif: ends in none"),
}


@pytest.mark.parametrize("case", WRONG, ids=list(WRONG))
def test_what_cannot_be_filmed_is_refused_at_once(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, message = WRONG[case]
    arguments = arguments if "--out" in arguments else [*arguments, "--out", "film.mp4"]
    with pytest.raises(InputError) as refused:
        cli.parse(arguments)()
    assert message in str(refused.value)
    assert list(tmp_path.iterdir()) == []


def test_a_film_is_made_of_a_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", "")
    save_recording(dataclasses.replace(RECORDING, steps=RECORDING.steps[1:2]), tmp_path / NAME)
    out = tmp_path / "new" / "film.webp"
    cli.parse(["video", str(tmp_path), "--out", str(out), "--width", "320", "--fps", "2"])()
    with Image.open(out) as picture:
        assert picture.size[0] == 320
        assert picture.n_frames > 1
    assert str(out) in capsys.readouterr().out.replace("\n", "")
