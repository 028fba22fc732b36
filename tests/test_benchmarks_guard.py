"""The guard: it fails for a significant loss, passes for noise, and says what it can notice."""

import dataclasses
import itertools
import json
import math

import pytest

from mechsearch_jax.benchmarks.guard import guard
from mechsearch_jax.benchmarks.guard.guard import Outcome, compare, detectable, power, sign_test, suite
from mechsearch_jax.benchmarks.running import evaluate as evaluation
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands.bench import episodes
from mechsearch_jax.envs.scenes.scene_sets import recorded
from mechsearch_jax.runtime.errors import InputError

ROW = EpisodeRow(
    "one", 2, "cylinder", "search-for-grasp", "oracle", 0.9, 3, 30, "push", 0, 1, 2, True, 3, None, 1.5, 0.5, "{}", "00"
)  # fmt: skip


def rows(retrieved):
    """A row for each flag; what is not retrieved is not graspable either."""
    return [
        dataclasses.replace(
            ROW, scenario=f"s{i}", content_hash=f"{i:02x}", retrieved=flag, graspable_step=2 if flag else None
        )
        for i, flag in enumerate(retrieved)
    ]


def outcomes(retrieved):
    return [Outcome.of_row(row) for row in rows(retrieved)]


def changed(flags, losses, gains):
    """The same flags with so many episodes lost and so many gained."""
    lost = [i for i, flag in enumerate(flags) if flag][:losses]
    gained = [i for i, flag in enumerate(flags) if not flag][:gains]
    return [not flag if i in (*lost, *gained) else flag for i, flag in enumerate(flags)]


BEFORE = [True] * 68 + [False] * 12


def test_the_sign_test_is_a_sum_over_coin_tosses():
    for gains, losses in itertools.product(range(8), repeat=2):
        n = gains + losses
        exact = sum(math.comb(n, k) for k in range(losses, n + 1)) / 2**n
        assert sign_test(gains, losses) == pytest.approx(exact)


@pytest.mark.parametrize(
    ("losses", "gains", "lost"),
    [(0, 0, False), (5, 0, False), (6, 0, True), (6, 6, False), (9, 2, False), (10, 2, True), (0, 12, False)],
)
def test_losses_are_significant_and_noise_is_not(losses, gains, lost):
    graspable, retrieved, actions = compare(outcomes(BEFORE), outcomes(changed(BEFORE, losses, gains)))
    assert (retrieved.measure, retrieved.pairs, retrieved.before) == ("retrieved", 80, 68)
    assert (retrieved.losses, retrieved.gains, retrieved.now) == (losses, gains, 68 - losses + gains)
    assert retrieved.lost is graspable.lost is lost
    # A target that is not retrieved took longer, and one that is took less.
    assert (actions.losses, actions.gains) == (losses, gains)


def test_a_measure_is_lost_alone():
    now = [dataclasses.replace(one, graspable=True) for one in outcomes(changed(BEFORE, 6, 0))]
    graspable, retrieved, _ = compare(outcomes(BEFORE), now)
    assert (graspable.losses, graspable.gains, graspable.lost, retrieved.lost) == (0, 12, False, True)


@pytest.mark.parametrize(("longer", "shorter", "lost"), [(6, 0, False), (7, 0, True), (14, 5, False), (14, 3, True)])
def test_retrievals_that_take_longer_are_a_loss(longer, shorter, lost):
    changes = [2] * longer + [-1] * shorter + [0] * (len(BEFORE) - longer - shorter)
    pairs = zip(outcomes(BEFORE), changes, strict=True)
    now = [dataclasses.replace(outcome, steps=outcome.steps + change) for outcome, change in pairs]
    graspable, retrieved, actions = compare(outcomes(BEFORE), now)
    assert (actions.gains, actions.losses, actions.lost) == (shorter, longer, lost)
    assert actions.now - actions.before == 2 * longer - shorter
    assert not graspable.lost
    assert not retrieved.lost


def test_pairs_are_of_the_same_scene_and_seed():
    now = outcomes(BEFORE)[::-1]
    assert all((one.losses, one.gains) == (0, 0) for one in compare(outcomes(BEFORE), now))
    assert compare(outcomes(BEFORE), now[:40])[0].pairs == 40
    for strange in (dataclasses.replace(now[0], seed=1), dataclasses.replace(now[0], content_hash="other")):
        with pytest.raises(InputError, match=f"the reference does not hold {strange.scenario} as it is here"):
            compare(outcomes(BEFORE), [*now[1:], strange])
    with pytest.raises(InputError, match="does not hold anything"):
        compare(outcomes(BEFORE), [])


def test_power_is_that_of_all_possible_changes():
    pairs, loss, flips, alpha = 12, 0.3, 0.1, 0.025
    gain, lose, total = flips / 2, flips / 2 + loss, 0.0
    for gains, losses in itertools.product(range(pairs + 1), repeat=2):
        same = pairs - gains - losses
        if same >= 0 and sign_test(gains, losses) <= alpha:
            ways = math.factorial(pairs) // (math.factorial(gains) * math.factorial(losses) * math.factorial(same))
            total += ways * gain**gains * lose**losses * (1 - gain - lose) ** same
    assert power(pairs, loss, flips, alpha) == pytest.approx(total)
    for scenes in guard.SUITES:
        assert power(scenes, 0.0) <= guard.MEASURES["retrieved"].alpha
        assert power(scenes, detectable(scenes)) >= guard.POWER > power(scenes, detectable(scenes) - 0.005)


def test_a_suite_has_as_many_scenes_of_each_number_of_objects():
    for scenes, each in guard.SUITES.items():
        chosen = suite(scenes)
        assert len(chosen) == len(set(chosen)) == scenes
        assert [sum(block.objects == n for block, _ in chosen) for n in (2, 4, 6, 8)] == [each] * 4
        assert all(recorded()[block.name][index] for block, index in chosen)
    assert set(suite(40)) < set(suite(80))
    with pytest.raises(InputError, match="there is no suite of 41 scenes; there are 40, 80, 160"):
        suite(41)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs the command, whose episodes come to what is given; nothing is planned."""
    monkeypatch.setattr(episodes, "files_of", lambda scenes: [])
    reference = tmp_path / "guard.json"

    def run(retrieved, *arguments):
        monkeypatch.setattr(evaluation, "evaluate", lambda *_: rows(retrieved))
        cli.parse(["bench", "guard", "--out", str(tmp_path / "rows"), "--reference", str(reference), *arguments])()

    run.reference = reference
    return run


def test_the_command_fails_after_a_loss_and_passes_noise(run, capsys):
    with pytest.raises(InputError, match=r"guard.json: cannot be read .*--write"):
        run(BEFORE)
    run(BEFORE, "--write")
    stored = json.loads(run.reference.read_text())
    assert stored["command"].startswith("mechsearch")
    assert stored["retrieved"] == {"2": 0.85}
    assert guard.read_reference(run.reference) == (stored["code"], outcomes(BEFORE))
    for passing in (BEFORE, changed(BEFORE, 7, 5), changed(BEFORE, 0, 12)):
        run(passing)
        assert "no significant loss" in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        run(changed(BEFORE, 8, 0))
    assert end.value.code == 1
    printed = capsys.readouterr().out
    assert "lost" in printed
    assert "0.004" in printed


def test_what_is_no_reference_is_refused(run):
    for text in ("{", "[]", '{"columns": ["a"], "rows": [[1]]}'):
        run.reference.write_text(text)
        with pytest.raises(InputError, match=r"guard.json: is no"):
            run(BEFORE)


def test_episodes_that_could_not_be_run_are_no_reference(tmp_path):
    broken = dataclasses.replace(ROW, failure="error: ValueError: no")
    for given, complaint in (
        ([ROW, broken], "one ended with 'error: ValueError: no'"),
        ([], "there are no episodes"),
    ):
        with pytest.raises(InputError, match=complaint):
            guard.save_reference(given, "mechsearch", tmp_path / "guard.json")
    assert not (tmp_path / "guard.json").exists()
