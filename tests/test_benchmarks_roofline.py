"""The roofline: what is timed, what a file keeps of it, and the page that is made from files."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.benchmarks.parts import bench, ceilings, dense, roofline
from mechsearch_jax.benchmarks.parts.bench import Timing
from mechsearch_jax.benchmarks.parts.ceilings import Ceiling
from mechsearch_jax.benchmarks.report.tables import timings_table
from mechsearch_jax.commands import main as cli
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

RESULTS = Path(__file__).parent.parent / "benchmarks" / "results"
H200 = {"device": "gpu: NVIDIA H200", "jax": "0.11.2"}


def timing(subject, shapes, seconds, objects=8, versions=H200):
    return Timing(subject, objects, shapes, 1.0, seconds, versions)


# 7e9 special functions take 2 ms, so that 1e9 evaluations cannot take less.
MEASURED = [
    timing("inside: gauge", {"placed": 100, "points": 1280, "evaluations": 10**9}, (0.02,)),
    timing("inside: kernel", {"placed": 100, "points": 1280, "evaluations": 10**9}, (0.005, 0.004, 0.0039)),
    timing("ceiling: special functions", {"operations": 7 * 10**9}, (0.002,), objects=0),
    timing("ceiling: multiply-adds", {"operations": 17 * 10**9}, (0.001,), objects=0),
    timing("ceiling: memory", {"bytes": 4 * 10**9}, (0.001,), objects=0),
]
SIMULATED = timing("simulate", {"worlds": 4096, "steps": 250}, (4.096,))


@pytest.fixture
def small_ceilings(monkeypatch):
    ceiling = Ceiling(lambda x: x + 1.0, jnp.zeros(8), 64)
    monkeypatch.setattr(roofline, "CEILINGS", {"special functions": ("operations", lambda: ceiling)})


def test_a_timing_counts_what_it_does():
    assert [t.unit for t in (MEASURED[0], MEASURED[2], MEASURED[4], SIMULATED)] == [
        "evaluations", "operations", "bytes", "steps",
    ]  # fmt: skip
    assert MEASURED[1].rate == pytest.approx(10**9 / 0.004)
    assert SIMULATED.rate == pytest.approx(250_000)
    assert timing("plan", {"poses": 792}, (1.0,)).rate is None


def test_all_versions_give_the_same():
    arguments = roofline.placed_clouds(5, 3, 40)
    expected = dense.least_gauges(*arguments)
    np.testing.assert_allclose(jax.jit(roofline.plain_gauges)(*arguments), expected, rtol=1e-5, atol=1e-5)
    assert (expected < 1).any()


def test_what_is_measured_is_kept_and_shown(small_ceilings, tmp_path):
    timings = roofline.bench_inside(3, objects=2, points=10, repeats=2)
    subjects = [t.subject for t in timings]
    assert subjects[:2] == ["inside: gauge", "inside: xla"]
    assert subjects[-1] == "ceiling: special functions"
    assert timings[0].shapes["evaluations"] == 60
    assert all(len(t.seconds) == 2 and min(t.seconds) > 0 for t in timings)
    assert timings_table(timings).row_count == len(timings)
    bench.save_timings(timings, tmp_path / "inside.json")
    bench.save_timing(SIMULATED, tmp_path / "simulate.json")
    bench.save_timing(timing("plan", {"poses": 792}, (1.0,)), tmp_path / "plan.json")
    kept = json.loads((tmp_path / "inside.json").read_text())["timings"]
    assert kept[0]["evaluations_per_second"] == pytest.approx(60 / kept[0]["median_seconds"])
    assert roofline.read_timings(tmp_path) == [*timings, SIMULATED]


@pytest.mark.parametrize("name", ["special functions", "multiply-adds"])
def test_chains_do_not_run_away(name):
    unit, make = ceilings.CEILINGS[name]
    ceiling = make()
    assert unit == "operations"
    assert ceiling.amount >= 10**7
    result = jax.jit(ceiling.function)(ceiling.argument)
    # Infinities and subnormal numbers may be faster, or slower, than others.
    assert np.isfinite(result).all()
    assert np.abs(result).min() > 1e-3


def test_the_page_tells_the_shares():
    page = roofline.page([*MEASURED, SIMULATED])
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:1] == "|"]
    cells = {row[0]: row[1:] for row in rows}
    special = 132 * 16 * 1.98e9
    rate = roofline.VERSIONS["inside: kernel"]
    assert cells[rate] == ["250 G", "3.9 to 5 ms", "50%", f"{100 * 250e9 * 7 / special:.3g}%"]
    assert cells[roofline.VERSIONS["inside: gauge"]][0] == "50.0 G"
    assert cells["special functions"] == ["3.50 T/s", "4.18 T/s", "7", "500 G", "50%"]
    assert cells["multiply-adds"][3:] == ["1.00 T", "25%"]
    assert cells["memory"][:3] == ["4.00 TB/s", "4.80 TB/s", "0.1 B"]
    limit = 4e12 / (2 * roofline.WORLD_BYTES)
    assert cells["gpu: NVIDIA H200"][:3] == ["4,096", "250,000", "4.00 TB/s (measured)"]
    assert cells["gpu: NVIDIA H200"][4] == f"{100 * 250_000 / limit:.3g}%"


def test_unknown_devices_and_missing_ceilings_leave_gaps():
    there = {"device": "cpu: cpu", "jax": "0.10.2"}
    alone = [dataclasses.replace(t, versions=there) for t in (MEASURED[0], SIMULATED)]
    page = roofline.page(alone)
    assert "| 50.0 G | 20 to 20 ms | – | – |" in page
    assert "| cpu: cpu | 4,096 | 250,000 | – | – | – |" in page
    assert "NaN" not in page


def test_the_page_in_the_repository_is_what_its_results_say():
    assert (RESULTS.parent / "roofline.md").read_text() == roofline.page(roofline.read_timings(RESULTS))


def test_the_command_writes_the_page(tmp_path, capsys):
    cli.parse(["bench", "roofline", str(RESULTS), "--out", str(tmp_path / "page.md")])()
    assert (tmp_path / "page.md").read_text().startswith("# ")
    assert "page.md" in capsys.readouterr().out


ODD = ["{", '{"subject": "simulate"}', '{"timings": 3}', '{"timings": [3]}', '{"subject": "simulate", "seconds": 1}']


@pytest.mark.parametrize("text", ODD)
def test_what_is_no_result_is_named(tmp_path, text):
    (tmp_path / "odd.json").write_text(text)
    with pytest.raises(InputError, match=r"odd\.json: is no result of bench"):
        roofline.read_timings(tmp_path)


def test_the_bytes_of_a_world_are_the_simulators():
    pytest.importorskip("warp")
    from mechsearch_jax.envs.simulators.mjx_model import MjxConfig, MjxModel

    data = MjxModel(Shelf(), Camera(), MjxConfig()).make_data(8)
    total = sum(leaf.nbytes for leaf in jax.tree.leaves(data))
    assert total / 8 == pytest.approx(roofline.WORLD_BYTES, rel=0.01)
