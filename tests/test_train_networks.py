"""The networks of perception, their losses against NumPy, their weights in files, and training that goes on."""

import dataclasses
import functools
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from mechsearch_jax.images import segments as clouds
from mechsearch_jax.images.labels import FREE, MISSING, OTHER
from mechsearch_jax.images.segments import HIDDEN_EDGE, INNER, OUTLINE
from mechsearch_jax.networks import recognition as model
from mechsearch_jax.networks import segmentation as layers
from mechsearch_jax.networks.recognition import BASE_ROTATIONS, HYPOTHESES, IS_ROUND, RecognitionConfig
from mechsearch_jax.networks.segmentation import (
    SegmentationConfig,
    nearest_neighbours,
    strongest_neighbour,
)
from mechsearch_jax.networks.weights import load_weights, save_weights
from mechsearch_jax.perception.segmentation import clean_up, labels_of, spread_labels
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.primitives import BOX, CYLINDER
from mechsearch_jax.train import recognition, scenes, segmentation
from mechsearch_jax.train.loop import CHECKPOINT, SCALARS, TrainConfig, initial_state, learning_rate, train

RECOGNITION = RecognitionConfig(width=32, layers=1, heads=2)
SEGMENTATION = SegmentationConfig(width=32, layers=2, heads=2, neighbours=8, latents=12)


@functools.cache
def drawn(name):
    """Draws weights, by one program instead of hundreds."""
    network = {"recognition": RECOGNITION, "segmentation": SEGMENTATION}[name]
    task = {"recognition": recognition.RecognitionTask, "segmentation": segmentation.SegmentationTask}[name]
    return jax.jit(task(network=network).init)


@functools.cache
def parameters(name):
    return drawn(name)(jax.random.key(1))


@pytest.fixture
def one_program(monkeypatch):
    draw = drawn("segmentation")
    monkeypatch.setattr(segmentation.SegmentationTask, "init", lambda task, key: draw(key))


# --- segmentation ----------------------------------------------------------------------------------------------------


# The CPU takes the one, a GPU the other.
WAYS = {"here": nearest_neighbours, "sorting": layers._neighbours_by_sorting, "passes": layers._neighbours_by_passes}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("count", [1, 5, 20])
def test_nearest_neighbours_are_the_nearest_and_of_equals_the_first(way, count):
    rng = np.random.default_rng(0)
    # On a grid distances are exact, and most of them equal; many points are twice there.
    clouds = np.stack([rng.random((60, 3)), rng.integers(0, 4, (60, 3)) / 8]).astype(np.float32)
    find = jax.vmap(functools.partial(WAYS[way], count=count))
    distance = np.linalg.norm(clouds[:, :, None].astype(float) - clouds[:, None], axis=-1)
    expected = np.argsort(distance, axis=2, kind="stable")[..., :count]
    assert np.array_equal(jax.jit(find)(clouds), expected)
    assert np.array_equal(find(jnp.asarray(clouds)), expected)


def test_who_is_nearest_has_no_slope_but_where_it_is_has():
    points = jax.random.uniform(jax.random.key(0), (20, 3))
    slope = jax.jit(jax.grad(lambda x: jnp.sum(x[nearest_neighbours(x, 3)])))(points)
    counts = np.bincount(np.asarray(nearest_neighbours(points, 3)).reshape(-1), minlength=20)
    assert np.array_equal(slope, np.repeat(counts[:, None], 3, axis=1))


@pytest.mark.parametrize("count", [1, 5, 7])
def test_the_strongest_neighbour_and_its_gradient_are_those_of_plain_differentiation(count):
    keys = jax.random.split(jax.random.key(3), 5)
    features = jax.random.normal(keys[0], (30, 8))
    offsets = jax.random.normal(keys[1], (30, count, 3))
    place = jax.random.normal(keys[2], (3, 8))
    # A point may be the neighbour of many, or of none; one is a neighbour twice.
    neighbours = jax.random.randint(keys[3], (30, count), 0, 11)
    weight = jax.random.normal(keys[4], (30, 8))

    def plain(features, offsets, place):
        response = features[neighbours] + jnp.matmul(offsets, place, precision="highest")
        return jnp.sum(weight * jnp.sin(jnp.max(response, axis=1)))

    def ours(features, offsets, place):
        return jnp.sum(weight * jnp.sin(strongest_neighbour(features, offsets, place, neighbours)))

    arguments = (features, offsets, place)
    expected, slopes = jax.jit(jax.value_and_grad(plain, argnums=(0, 1, 2)))(*arguments)
    value, ours_slopes = jax.jit(jax.value_and_grad(ours, argnums=(0, 1, 2)))(*arguments)
    assert value == pytest.approx(float(expected), rel=1e-5)
    for a, b in zip(ours_slopes, slopes, strict=True):
        assert np.allclose(a, b, atol=1e-5)
        assert np.abs(b).max() > 0.1


def numpy_segmentation_loss(logits, labels):
    """The matched loss in float64, with SciPy's assignment."""
    logits = logits.astype(float)
    probability = np.exp(logits - logits.max(axis=1, keepdims=True))
    probability /= probability.sum(axis=1, keepdims=True)
    present = [k for k in range(9) if (labels == k).any()]
    cost = np.zeros((len(present), 9))
    overlap = np.zeros_like(cost)
    for row, k in enumerate(present):
        own = labels == k
        for instance in range(9):
            p = probability[:, instance]
            overlap[row, instance] = 1 - (2 * p[own].sum() + 1) / (p.sum() + own.sum() + 1)
            cost[row, instance] = -np.log(p[own]).mean() + 2 * overlap[row, instance]
    rows, columns = linear_sum_assignment(cost)
    wanted = np.full(len(labels), 9)
    for row, column in zip(rows, columns, strict=True):
        wanted[labels == present[row]] = column
    cross = -np.log(probability[np.arange(len(labels)), wanted]).mean()
    return cross, overlap[rows, columns].mean()


@pytest.mark.parametrize("seed", range(3))
def test_the_matched_loss_is_numpys_and_knows_no_numbering(seed):
    rng = np.random.default_rng(seed)
    labels = rng.choice([OTHER, 0, 2, 5, 8], 120).astype(np.int8)
    logits = rng.normal(size=(120, 10)).astype(np.float32) * 2
    loss = jax.jit(segmentation.segmentation_loss)
    terms = loss(jnp.asarray(logits), jnp.asarray(labels))
    cross, overlap = numpy_segmentation_loss(logits, labels)
    assert terms["cross_entropy"] == pytest.approx(cross, rel=1e-4)
    assert terms["dice"] == pytest.approx(overlap, rel=1e-4)

    numbers = np.append(rng.permutation(9), OTHER).astype(np.int8)
    instances = np.append(rng.permutation(9), 9)
    for other_logits, other_labels in ((logits, numbers[labels]), (logits[:, instances], labels)):
        again = loss(jnp.asarray(other_logits), jnp.asarray(other_labels))
        assert again["cross_entropy"] == pytest.approx(float(terms["cross_entropy"]), rel=1e-5)
        assert again["dice"] == pytest.approx(float(terms["dice"]), rel=1e-5)


def test_a_right_segmentation_costs_nothing():
    labels = jnp.asarray(np.repeat([0, 1, 4, OTHER], 30), jnp.int8)
    names = jnp.asarray([7, 2, 0, 1, 5, 3, 4, 6, 8, 9])
    logits = 20.0 * jax.nn.one_hot(names[jnp.where(labels == OTHER, 9, labels)], 10)
    terms = jax.jit(segmentation.segmentation_loss)(logits, labels)
    assert terms["cross_entropy"] < 1e-6
    assert terms["accuracy"] == 1.0
    segments = labels_of(logits)
    overlap, present = segmentation.instance_overlaps(segments, labels)
    assert np.array_equal(present, np.isin(np.arange(9), [0, 1, 4]))
    assert np.allclose(overlap[present], 1.0)


def test_clean_up_removes_specks_and_dissolves_small_segments():
    rng = np.random.default_rng(0)
    two = np.concatenate([rng.normal((0.5, 0, 0.45), 0.01, (100, 3)), rng.normal((0.6, 0, 0.45), 0.01, (100, 3))])
    far = np.full((3, 3), 2.0) + rng.normal(0, 1e-3, (3, 3))
    points = np.concatenate([two, far]).astype(np.float32)
    truth = np.repeat([4, 1, OTHER], [100, 100, 3]).astype(np.int8)
    labels = truth.copy()
    labels[[3, 50, 120, 190]] = [1, 7, 4, 6]
    labels[200:] = 2
    clean = np.asarray(clean_up(jnp.asarray(points), jnp.asarray(labels), jnp.ones(203, bool)))
    assert np.array_equal(clean, truth)
    gone = np.asarray(clean_up(jnp.asarray(points), jnp.asarray(labels), jnp.arange(203) < 100))
    assert (gone[100:] == OTHER).all()
    assert np.array_equal(gone[:100], truth[:100])


def test_labels_spread_to_the_pixels_nearby():
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(10), indexing="ij"), axis=-1) * 0.01
    points = np.concatenate([grid, np.zeros((6, 10, 1))], axis=-1).astype(np.float32)
    points[0, 0] = np.nan
    candidates = np.ones((6, 10), bool)
    candidates[5] = False
    cloud = np.array([(0.02, 0.01, 0.0), (0.02, 0.06, 0.0)], np.float32)
    spread = np.asarray(
        spread_labels(
            jnp.asarray(points), jnp.asarray(candidates), jnp.asarray(cloud), jnp.array([3, 0], jnp.int8), reach=0.035
        )
    )
    assert spread[0, 0] == MISSING
    assert (spread[5] == FREE).all()
    assert (spread[1:4, :4] == 3).all()
    assert (spread[1:4, 4:8] == 0).all()
    assert spread[2, 9] == 0 or spread[2, 9] == OTHER
    assert spread[4, 9] == OTHER


# --- segments --------------------------------------------------------------------------------------------------------


def test_edges_tell_what_ends_from_what_is_hidden():
    labels = np.full((7, 9), FREE, np.int8)
    labels[1:6, 1:5] = 0
    labels[1:6, 5:8] = 1
    labels[3, 2] = MISSING
    distance = np.where(labels == 0, 0.9, np.where(labels == 1, 0.7, 1.2)).astype(np.float32)
    marks = np.asarray(clouds.edge_marks(jnp.asarray(distance), jnp.asarray(labels)))
    assert (marks[1:6, 4] == HIDDEN_EDGE).all()
    assert (marks[1, 1:4] == OUTLINE).all()
    assert (marks[2:5, 1] == OUTLINE).all()
    assert (marks[1:6, 5] == OUTLINE).all()
    assert marks[3, 3] == INNER
    assert marks[2, 2] == INNER


@functools.cache
def drawn_segments():
    task = recognition.RecognitionTask(network=RECOGNITION, precision=jnp.float32)
    keys = jax.random.split(jax.random.key(5), 3)
    return task, jax.jit(jax.vmap(task.scene))(keys)


# --- recognition -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_recognition_does_not_mind_the_order_of_the_points():
    task, (_, _, examples) = drawn_segments()
    segments = jax.tree.map(lambda a: a[0], examples.segments)
    order = jax.random.permutation(jax.random.key(0), task.segments.points)
    network = jax.jit(functools.partial(model.apply_network, model.RecognitionNetwork(RECOGNITION)))
    hypotheses = network(parameters("recognition"), segments.points, segments.mark, segments.camera)
    again = network(parameters("recognition"), segments.points[:, order], segments.mark[:, order], segments.camera)
    for a, b in zip(jax.tree.leaves(hypotheses), jax.tree.leaves(again), strict=True):
        assert np.allclose(a, b, atol=1e-4)
    assert (np.asarray(hypotheses.size) > 0).all()
    assert (np.asarray(hypotheses.exponents) >= 0.05).all()
    assert (np.asarray(hypotheses.exponents) <= 1.2).all()
    cylinders = np.asarray(hypotheses.size)[:, IS_ROUND]
    assert np.array_equal(cylinders[..., 0], cylinders[..., 1])


def test_rotation_vectors_are_scipys():
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    vectors[0] = 0
    vectors[1] *= 1e-6
    expected = Rotation.from_rotvec(vectors).as_matrix()
    matrices = jax.jit(model.rotation_of)(jnp.asarray(vectors, jnp.float32))
    assert np.allclose(matrices, expected, atol=1e-5)
    back = Rotation.from_matrix(expected).as_rotvec()
    short = np.linalg.norm(back, axis=1) < 3.0
    computed = jax.jit(recognition.rotation_vector)(jnp.asarray(expected, jnp.float32))
    assert np.allclose(computed[short], back[short], atol=1e-4)
    slope = jax.jit(jax.jacobian(model.rotation_of))(jnp.zeros(3))
    assert np.isfinite(slope).all()
    assert slope[2, 1, 0] == pytest.approx(1.0)


def same_body(kind, half, rotation, other_half, other_rotation):
    """Whether two descriptions at the same place are of the same body, by its corners or its axis, in float64."""
    if kind == CYLINDER:
        aligned = abs(rotation[:, 2] @ other_rotation[:, 2])
        return aligned > 1 - 1e-6 and np.allclose(half, other_half, atol=1e-6)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    first, second = (signs * half) @ rotation.T, (signs * other_half) @ other_rotation.T
    distance = np.linalg.norm(first[:, None] - second[None], axis=-1)
    return distance.min(axis=1).max() < 1e-5 and distance.min(axis=0).max() < 1e-5


@pytest.mark.parametrize("kind", [BOX, CYLINDER])
def test_every_answer_describes_the_same_body(kind):
    rng, answers = np.random.default_rng(kind), jax.jit(recognition.answers)
    for _ in range(20):
        turn = Rotation.from_rotvec([rng.normal(0, 0.2), 0, 0]) * Rotation.from_euler("z", rng.uniform(-4, 4))
        if rng.random() < 0.5:
            turn = Rotation.from_euler("z", rng.uniform(-4, 4)) * Rotation.from_euler("x", np.pi / 2)
        rotation = turn.as_matrix()
        half = rng.uniform(0.01, 0.1, 3)
        half[1] = half[0] if kind == CYLINDER else half[1]
        answer = answers(jnp.int32(kind), jnp.asarray(half, jnp.float32), jnp.asarray(rotation, jnp.float32))
        assert answer.right.sum() == 1
        assert (np.asarray(answer.right) <= np.asarray(answer.taught)).all()
        for k in np.flatnonzero(np.asarray(answer.taught)):
            assert IS_ROUND[k] == (kind == CYLINDER)
            turned = BASE_ROTATIONS[k] @ Rotation.from_rotvec(np.asarray(answer.turn[k])).as_matrix()
            assert same_body(kind, half, rotation, np.asarray(answer.half_size[k]), turned)
        best = np.linalg.norm(answer.turn[np.argmax(answer.right)])
        # Level bodies are within half a part of the yaw angles of their hypothesis.
        if np.abs(rotation[2]).max() > 1 - 1e-9:
            assert best < np.pi / 12 + 1e-5


def outputs_for(truth):
    """Hypotheses that say just what is right of a body."""
    right = jax.jit(recognition.answers)(truth.kind, truth.half_size, truth.rotation)
    base = jnp.asarray(BASE_ROTATIONS)
    rotation = model.matmul(base, jax.jit(model.rotation_of)(right.turn))
    edges = np.stack([np.full(HYPOTHESES, 0.05), np.where(IS_ROUND, 1.0, 0.05)], axis=-1)
    return model.Hypotheses(
        logit=jnp.where(right.right, 20.0, -20.0),
        size=right.half_size,
        exponents=jnp.asarray(edges, jnp.float32),
        position=jnp.broadcast_to(truth.position[None], (HYPOTHESES, 3)),
        rotation=rotation,
        turn=right.turn,
        log_scale=jnp.zeros((HYPOTHESES, 6)),
    )


@pytest.mark.parametrize("kind", [BOX, CYLINDER])
def test_the_loss_is_equation_7_and_vanishes_at_the_truth(kind):
    half = jnp.array([0.03, 0.03, 0.06])
    turn = jnp.asarray(Rotation.from_euler("z", 0.3).as_matrix(), jnp.float32)
    position = jnp.array([0.02, -0.01, 0.06])
    local = scenes.surface_points(jax.random.key(0), jnp.int32(kind), half, recognition.SURFACE)
    surface = jnp.einsum("ij,pj->pi", turn, local) + position[None]
    truth = recognition.Truth(jnp.int32(kind), half, position, turn, surface)
    hypotheses = outputs_for(truth)
    loss = jax.jit(recognition.example_loss)
    terms = loss(hypotheses, truth)
    assert terms["correct"] == 1.0
    for name in ("turn", "size", "position"):
        assert terms[name] < 1e-5, name
    # What is left of the surface's is the rounding of edges with an exponent of 0.05: tenths of a millimetre.
    assert terms["surface"] < 0.1

    wrong = hypotheses.replace(
        position=hypotheses.position + jnp.array([[0.004, 0.0, 0.0]]), size=hypotheses.size * 1.1
    )
    terms = loss(wrong, truth)
    winner = int(jnp.argmax(wrong.logit))
    rotation = np.asarray(wrong.rotation[winner], float)
    x = (np.asarray(surface, float) - np.asarray(wrong.position[winner])) @ rotation
    e1, e2 = (float(e) for e in wrong.exponents[winner])
    size = np.asarray(wrong.size[winner], float)
    plane = np.abs(x[:, 0] / size[0]) ** (2 / e2) + np.abs(x[:, 1] / size[1]) ** (2 / e2)
    S = plane ** (e2 / e1) + np.abs(x[:, 2] / size[2]) ** (2 / e1)
    delta = np.linalg.norm(x, axis=1) * np.abs(1 - S ** (-e1 / 2))
    assert terms["surface"] == pytest.approx(np.sqrt(np.mean(delta**2)) / 0.01, rel=1e-3)
    assert terms["position"] == pytest.approx(0.4 / 3, rel=1e-3)
    slope = jax.jit(jax.grad(lambda t: sum(loss(t, truth).values())))(wrong)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(slope))


# --- weights ---------------------------------------------------------------------------------------------------------


def test_weights_come_back_as_they_went(tmp_path):
    path = tmp_path / "recognition.npz"
    save_weights(path, "recognition", RECOGNITION, parameters("recognition"), {"seed": 3, "scores": {"a": 0.5}})
    loaded = load_weights(path, "recognition")
    assert loaded.network.config == RECOGNITION
    assert loaded.card["seed"] == 3
    for a, b in zip(jax.tree.leaves(parameters("recognition")), jax.tree.leaves(loaded.parameters), strict=True):
        assert np.allclose(a, b, rtol=1e-3, atol=1e-6)
        assert b.dtype == jnp.float32


def test_both_networks_fit_ten_megabytes():
    total = 0
    for task in (recognition.RecognitionTask(), segmentation.SegmentationTask()):
        shapes = jax.eval_shape(task.init, jax.random.key(0))
        total += sum(2 * leaf.size for leaf in jax.tree.leaves(shapes))
    assert total < 9.5e6


# --- training --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Line:
    """A task for the loop alone: a straight line through noisy points."""

    name: str = "line"

    @property
    def origin(self):
        return {"source": "a straight line"}

    def init(self, key):
        return {"slope": jax.random.normal(key, (1, 1)), "offset": jnp.zeros(1)}

    def sample(self, key, batch):
        at, noise = jax.random.split(key)
        x = jax.random.uniform(at, (batch, 1))
        return x, 3.0 * x - 1.0 + 0.01 * jax.random.normal(noise, (batch, 1))

    def loss(self, parameters, examples):
        x, y = examples
        error = x @ parameters["slope"] + parameters["offset"][None] - y
        return jnp.mean(error**2), {"error": jnp.mean(jnp.abs(error))}

    def scores(self, parameters, scenes):
        return {}

    def save(self, path, parameters, card):
        raise AssertionError("the loop writes checkpoints, not weights")


class Killed(Exception):
    pass


def test_killed_training_goes_on_to_the_same_weights(tmp_path):
    config = TrainConfig(seed=2, steps=60, batch=16, rate=0.1, chunk=7, save_every=1e-9)
    whole = train(Line(), config, tmp_path / "whole")

    def kill(progress, step, seconds, scalars):
        if step == 28:
            raise Killed

    with pytest.raises(Killed):
        train(Line(), config, tmp_path / "killed", kill)
    with open(tmp_path / "killed" / SCALARS, "a") as file:
        file.write('{"step": 28, "los')
    resumed = train(Line(), config, tmp_path / "killed")
    assert resumed.step == whole.step == 60
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(resumed), strict=True):
        assert np.array_equal(a, b)
    curves = [
        [json.loads(line) for line in (tmp_path / name / SCALARS).read_text().splitlines()]
        for name in ("whole", "killed")
    ]
    assert [line["step"] for line in curves[0]] == [line["step"] for line in curves[1]]
    assert [line["loss"] for line in curves[0]] == [line["loss"] for line in curves[1]]
    assert curves[0][-1]["loss"] < 0.1 * curves[0][0]["loss"]


def test_training_by_minutes_ends_and_checkpoints_are_guarded(tmp_path):
    state = train(Line(), TrainConfig(minutes=0.005, batch=8, chunk=5), tmp_path)
    assert state.step >= 5
    with pytest.raises(InputError, match="seed"):
        train(Line(), TrainConfig(minutes=0.005, batch=8, chunk=5, seed=1), tmp_path)
    (tmp_path / CHECKPOINT).write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match="checkpoint"):
        train(Line(), TrainConfig(minutes=0.005, batch=8, chunk=5), tmp_path)


def test_the_rate_warms_up_and_falls_to_nothing():
    config = TrainConfig(steps=100, rate=1.0, warm_up=0.1)
    assert learning_rate(0.05, config) == pytest.approx(0.5)
    assert learning_rate(0.1, config) == pytest.approx(1.0)
    assert learning_rate(0.55, config) == pytest.approx(0.5)
    assert learning_rate(1.0, config) == pytest.approx(0.0)


def test_a_step_without_a_finite_gradient_is_left_out():
    class Spoilt(Line):
        def sample(self, key, batch):
            x, y = super().sample(key, batch)
            return x, y * jnp.nan

    from mechsearch_jax.train.loop import make_steps

    config = TrainConfig(steps=3)
    before = initial_state(Spoilt(), config)
    kept = jax.device_get(before.parameters)
    after, scalars = make_steps(Spoilt(), config)(before, jnp.ones(3))
    assert scalars["skipped"] == 1.0
    assert np.array_equal(after.parameters["slope"], kept["slope"])


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({}, "steps"),
        ({"steps": 5, "minutes": 1.0}, "steps"),
        ({"steps": 0}, "steps"),
        ({"steps": 5, "seed": -1}, "seed"),
        ({"steps": 5, "seed": 2**31 - 1}, "held out"),
        ({"steps": 5, "batch": 0}, "batch"),
        ({"minutes": -1.0}, "minutes"),
    ],
)
def test_impossible_trainings_are_refused(wrong, reason):
    with pytest.raises(InputError, match=reason):
        TrainConfig(**wrong)


@pytest.mark.slow
@pytest.mark.usefixtures("one_program")
def test_training_begins_with_the_weights_that_it_is_given(tmp_path):
    task, archive = segmentation.SegmentationTask(network=SEGMENTATION), tmp_path / "segmentation.npz"
    save_weights(archive, "segmentation", SEGMENTATION, parameters("segmentation"), {})
    state = initial_state(task, TrainConfig(steps=1, seed=3, start=str(archive)))
    random = initial_state(task, TrainConfig(steps=1, seed=3))
    given = jax.tree.map(lambda a: np.asarray(a, np.float16), parameters("segmentation"))
    for first, averaged, wanted in zip(
        jax.tree.leaves(state.parameters), jax.tree.leaves(state.averaged), jax.tree.leaves(given), strict=True
    ):
        assert np.array_equal(first, wanted.astype(np.float32))
        assert np.array_equal(averaged, first)
    differ = jax.tree.map(lambda a, b: bool(np.any(a != b)), state.parameters, random.parameters)
    assert any(jax.tree.leaves(differ))


@pytest.mark.usefixtures("one_program")
def test_weights_of_other_sizes_are_no_beginning():
    with pytest.raises(InputError, match="of other sizes"):
        initial_state(segmentation.SegmentationTask(network=SEGMENTATION), TrainConfig(steps=1, start="shipped"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["segmentation", "recognition"])
def test_training_makes_the_loss_smaller(name, tmp_path):
    if name == "recognition":
        task = recognition.RecognitionTask(network=RECOGNITION, precision=jnp.float32)
    else:
        task = segmentation.SegmentationTask(network=SEGMENTATION, points=256, precision=jnp.float32)
    losses = []
    train(
        task,
        TrainConfig(steps=30, batch=4, rate=2e-3, chunk=5),
        tmp_path,
        lambda progress, step, seconds, scalars: losses.append(scalars["loss"]),
    )
    assert losses[-1] < 0.75 * losses[0]
