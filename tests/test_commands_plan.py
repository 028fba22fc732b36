"""`mechsearch plan`: from image files to a step, from call to call."""

import csv
import dataclasses
import json

import jax.numpy as jnp
import pytest
from stage import HIDDEN, OPEN, grab
from test_mutated_files import program
from test_search import IMAGES, TRUSTING, seen

from mechsearch_jax.commands import plan
from mechsearch_jax.envs.cell import loading as cell
from mechsearch_jax.images.image_files import (
    load_camera,
    load_colour,
    load_depth,
    load_mask,
    save_camera,
    save_depth,
    save_mask,
)
from mechsearch_jax.problem import problem as problems
from mechsearch_jax.problem.problem import NOWHERE
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.session.searcher import Searcher

WRITTEN = {"step.json", "step.png", "trajectory.csv", "trajectory.json"}
FILES = {"depth.png", "colour.png", "mask.png", "camera.json"}


@pytest.fixture
def see(problem, monkeypatch):
    """Let the command's searcher see a scenario, whatever the images show, and keep nothing on disk."""
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", "")
    monkeypatch.setattr(Workcell, "problem", lambda self, target=None, config=None: problem)

    def seeing(scenario):
        given = {"policy": grab, "trajectories": TRUSTING, "recogniser": lambda problem: lambda *images: seen(scenario)}

        def made(settings, *, camera, seed):
            return Searcher(dataclasses.replace(settings.workcell, camera=camera), settings.config, seed=seed, **given)

        monkeypatch.setattr(cell, "searcher_of", made)

    return seeing


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "give one of --depth IMAGE, --bop FOLDER, --bag BAG and --example"),
        (("--depth", "d.png", "--example"), "give one of --depth IMAGE, --bop FOLDER, --bag BAG and --example"),
        (("--depth", "d.png", "--image", "3"), "--image is a number in --bop or --bag"),
        (("--bop", "scene", "--topics", "depth=/d"), "--topics are those of --bag"),
        (("--bop", "scene", "--colour", "c.png"), "--bop has images and a camera of its own"),
        (("--example", "--mask", "m.png"), "leave --colour, --mask and --camera out"),
        (("--depth", "d.png", "--target-id", "3"), "give --mask, too"),
        (("--depth", "missing.png"), "missing.png: cannot be read"),
    ],
)
def test_what_does_not_fit_together_is_refused(arguments, words, tmp_path, monkeypatch):
    status, message = program(monkeypatch, "plan", *arguments, "--out", str(tmp_path / "out"))
    assert status == 2
    assert words in message
    assert len(message.splitlines()) == 1


def test_a_number_of_the_target_that_the_mask_file_does_not_have_is_said(tmp_path):
    depth, mask = tmp_path / "depth.png", tmp_path / "mask.png"
    save_depth(IMAGES.depth, depth)
    save_mask(IMAGES.mask, mask, 255)
    for number, words in ((200, "no pixel holds the target's number 200"), (-1, ""), (0, "")):
        images, _, said = plan.ImageFiles((depth,), mask=mask, target_id=number).load(None, IMAGES.camera)
        assert images["target_id"] == (0 if number == 0 else -1)
        assert words in " ".join(said)
        assert bool(said) == bool(words)


def files_of_a_user(folder, camera=IMAGES.camera):
    """The arguments for images as a user has them."""
    save_depth(IMAGES.depth, folder / "depth.png")
    save_camera(camera, folder / "camera.json")
    return "--depth", str(folder / "depth.png"), "--camera", str(folder / "camera.json"), "--out", str(folder / "out")


def test_a_shelf_out_of_reach_ends_it_with_one_line(problem, tmp_path, monkeypatch):
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", "")
    none = jnp.zeros(0, jnp.int32)
    nothing = problem.grasps.replace(pair_pose=none, pair_grasp=none, pair_valid=jnp.zeros(0, bool))
    monkeypatch.setattr(problems, "candidate_grasps", lambda *args, **kwargs: nothing)
    status, message = program(monkeypatch, "plan", *files_of_a_user(tmp_path))
    assert (status, message.strip()) == (2, f"mechsearch: {NOWHERE}")


@pytest.mark.slow
def test_the_example_is_planned_on_and_written_as_files_like_a_users(see, tmp_path, monkeypatch):
    see(OPEN)
    out = tmp_path / "out"
    assert program(monkeypatch, "plan", "--example", "--out", str(out))[0] == 0
    assert {file.name for file in out.iterdir()} == WRITTEN | FILES
    assert load_camera(out / "camera.json") == IMAGES.camera
    assert load_depth(out / "depth.png").shape == load_colour(out / "colour.png").shape[:2]
    assert len(load_mask(out / "mask.png", 255)[1]) > 0
    step = json.loads((out / "step.json").read_text())
    assert step["kind"] == "retrieve"
    assert step["motion"]["duration"] > 0
    assert (step["action"]["kind"], step["target"]["found"], len(step["objects"])) == ("retrieve", True, 1)
    assert step["cell"]["reach"] > 0.5
    with open(out / "trajectory.csv", newline="") as file:
        header, *rows = csv.reader(file)
    points = json.loads((out / "trajectory.json").read_text())["arm"]["points"]
    assert len(header) == len(rows[0]) == 17
    assert len(rows) == len(points)

    again = tmp_path / "again"
    files = ("--depth", str(out / "depth.png"), "--colour", str(out / "colour.png"), "--mask", str(out / "mask.png"))
    arguments = (*files, "--target-id", "200", "--camera", str(out / "camera.json"), "--out", str(again))
    assert program(monkeypatch, "plan", *arguments)[0] == 0
    step_again = json.loads((again / "step.json").read_text())
    # A number that the mask does not have may be a slip.
    assert "no pixel holds the target's number 200" in step_again["warnings"][0]
    assert {**step_again, "warnings": []} == step


@pytest.mark.slow
def test_a_search_goes_on_from_call_to_call(see, tmp_path, monkeypatch, capsys):
    see(OPEN)
    out, state = tmp_path / "out", tmp_path / "search.npz"
    command = ("plan", "--example", "--state", str(state), "--out", str(out))
    assert program(monkeypatch, *command)[0] == 0
    assert program(monkeypatch, *command, "--failed")[0] == 0
    assert json.loads((out / "step.json").read_text())["index"] == 1
    # Nothing is to be followed that is of another step.
    see(HIDDEN)
    assert program(monkeypatch, *command, "--failed")[0] == 0
    assert json.loads((out / "step.json").read_text())["motion"] is None
    assert not (out / "trajectory.csv").exists()
    see(OPEN)
    assert program(monkeypatch, *command)[0] == 0
    before = (out / "step.json").read_bytes()
    assert program(monkeypatch, *command)[0] == 0
    assert (out / "step.json").read_bytes() == before
