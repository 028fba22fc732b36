"""Scenes near a recognised one: which differences are drawn, and that each scene is made once."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from mechsearch_jax.envs.trials.nearby import Perturbations, PerturbedScenes
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.planner.trials import TrialScenes


def scenes(rows):
    objects = empty(8)
    objects = objects.replace(size=np.tile(np.float32([0.02, 0.05, 0.08]), (8, 1)))
    objects = jax.tree.map(lambda a: np.stack([np.asarray(a)] * rows), objects)
    ones = np.ones(rows, np.float32)
    return TrialScenes(objects, np.zeros((rows, 3), np.float32), np.ones(rows, bool), ones, ones)


def test_the_same_differences_whatever_else_is_tried():
    near = Perturbations()
    one, many = near.drawn(scenes(1), 2), near.drawn(scenes(3), 2)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(np.repeat(a, 3, axis=0), b)
        assert a.dtype == b.dtype
    other = near.drawn(scenes(1), 3)
    assert (one.objects.position[..., :2] != other.objects.position[..., :2]).all()
    assert near.drawn(many, 0) is many


def test_differences_are_as_large_as_they_are_said_to_be():
    near = Perturbations(place=3e-3, size=0.02)
    plain = scenes(1)
    drawn = [near.drawn(plain, n) for n in range(1, 400)]
    places = np.stack([d.objects.position - plain.objects.position for d in drawn])
    sizes = np.stack([d.objects.size / plain.objects.size - 1 for d in drawn])
    poses = np.stack([d.pose for d in drawn])
    for values, scale in ((places, 3e-3), (sizes, 0.02), (poses, 3e-3)):
        assert np.std(values[..., :2]) == pytest.approx(scale, rel=0.1)
        assert abs(np.mean(values[..., :2])) < 0.1 * scale
    # Heights, and the target's yaw.
    assert not places[..., 2].any()
    assert not poses[..., 2].any()
    np.testing.assert_allclose(sizes[..., 2], 0.0, atol=1e-6)
    assert all(d.objects.rotation is plain.objects.rotation for d in drawn)


def test_things_are_rougher_and_heavier_in_one_scene_and_smoother_and_lighter_in_another():
    near, plain = Perturbations(friction=1.5, mass=2.0), scenes(2)
    plain = plain.replace(friction=np.float32([1.0, 0.8]))
    drawn = [near.drawn(plain, number) for number in (1, 2, 3, 4)]
    for each, power in zip(drawn, (1, -1, 0, 1), strict=True):
        np.testing.assert_allclose(each.friction, np.float32([1.0, 0.8]) * 1.5**power, rtol=1e-6)
        np.testing.assert_allclose(each.mass, 2.0**power, rtol=1e-6)
        assert each.friction.dtype == each.mass.dtype == np.float32


def test_a_scene_is_made_once_by_whichever_thread_comes_first():
    made, begin = [], threading.Barrier(4)

    def make(number, kept):
        made.append(number)
        time.sleep(0.02)
        return None if number == 1 else f"scene {number}"

    near = PerturbedScenes(make)

    def take(_):
        begin.wait()
        return [near[n, (0, 2)] for n in range(3)]

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(take, range(4))) == [["scene 0", None, "scene 2"]] * 4
    assert sorted(made) == [0, 1, 2]
