"""What a checkout has to hold: imports point one way, the gate has its reference, files name one version."""

import ast
import importlib.util
import re
import runpy
import shlex
import tomllib
from pathlib import Path

import pytest

from mechsearch_jax.benchmarks.guard import guard
from mechsearch_jax.commands import main as cli

ROOT = Path(__file__).parents[1]
# By their folders; a package in another one is none of its rooms.
PACKAGES = {"lab": "benchmarks/lab", "benchmarks": "benchmarks", "train": "train", "envs": "envs"}
# What a package may import, beside itself.
BELOW = {
    "lab": {"benchmarks", "train", "envs", "mechsearch_jax"},
    "benchmarks": {"train", "envs", "mechsearch_jax"},
    "train": {"envs", "mechsearch_jax"},
    "envs": {"mechsearch_jax"},
}


def place(name):
    """The package and the room that a module of ours is in; None for any other."""
    first, *rest = name.split(".")
    if first != "mechsearch_jax":
        return None
    if rest[:2] == ["benchmarks", "lab"]:
        rest = rest[1:]
    package, room = [*rest, "", ""][:2]
    return (package, room) if package in PACKAGES else (first, package)


def imports(file):
    """The places that a file imports from, also inside of functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            packages = (f"mechsearch_jax.{folder.replace('/', '.')}" for folder in PACKAGES.values())
            submodules = node.module in ("mechsearch_jax", *packages)
            yield from (place(f"{node.module}.{name.name}" if submodules else node.module) for name in node.names)
        elif isinstance(node, ast.Import):
            yield from (place(name.name) for name in node.names)


def arrows(*packages):
    """From each room of these packages: which places it imports from."""
    imported = {}
    for package in packages:
        folder = ROOT / PACKAGES.get(package, package)
        for file in folder.rglob("*.py"):
            inside = file.relative_to(folder).parts
            if package == "benchmarks" and inside[0] == "lab":
                continue
            room = package, inside[0] if len(inside) > 1 else inside[0].removesuffix(".py")
            imported.setdefault(room, set()).update(other for other in imports(file) if other and other != room)
    return imported


def circles(imported):
    """The rooms that need one which needs them."""

    def reached(room):
        seen, left = set(), [room]
        while left:
            for other in imported.get(left.pop(), ()):
                if other not in seen:
                    seen.add(other)
                    left.append(other)
        return seen

    return {room for room in imported if room in reached(room)}


def test_packages_import_what_is_below_them_alone():
    imported = arrows(*PACKAGES)
    assert {package for package, _ in imported} == set(PACKAGES)
    wrong = {
        (room, other)
        for room, others in imported.items()
        for other in others
        if other[0] not in BELOW[room[0]] | {room[0]}
    }
    assert wrong == set()


def test_no_room_needs_one_that_needs_it():
    imported = arrows(*PACKAGES)
    assert ("envs", "simulators") in imported["envs", "trials"]
    assert ("lab", "parts") in imported["lab", "commands"]
    assert circles(imported) == set()


def test_nor_does_one_of_the_planner():
    imported = {
        room: others for room, others in arrows("mechsearch_jax").items() if room[1] not in ("__init__", "commands")
    }
    assert ("mechsearch_jax", "belief") in imported["mechsearch_jax", "planner"]
    assert circles(imported) == set()


def test_the_planner_knows_no_benchmarks_and_in_one_place_the_simulators():
    for file in (ROOT / "mechsearch_jax").rglob("*.py"):
        inside = file.relative_to(ROOT / "mechsearch_jax").parts
        above = {"envs"} if inside == ("session", "simulated.py") else set()
        if inside[0] == "commands":
            above = {"envs", "train", "benchmarks"}
        assert {other[0] for other in imports(file) if other} <= {"mechsearch_jax"} | above, file


def test_the_lab_is_no_part_of_the_wheel(monkeypatch):
    setuptools = pytest.importorskip("setuptools")
    found = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(setuptools, "setup", found.update)
    runpy.run_path("setup.py")
    packages = {package for package in found["packages"] if package.startswith("mechsearch_jax.benchmarks")}
    assert {"mechsearch_jax.benchmarks", "mechsearch_jax.benchmarks.report"} < packages
    assert not [package for package in packages if place(package)[0] == "lab"]
    data = tomllib.loads(Path("pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert set(data) <= set(found["packages"])


def test_the_gate_has_a_reference_for_each_of_its_episodes():
    (line,) = re.findall(r'^step "mechsearch (bench guard .*)"$', (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    arguments = shlex.split(line)
    assert callable(cli.parse(arguments))
    scenes, reference = (arguments[arguments.index(name) + 1] for name in ("--scenes", "--reference"))
    outcomes = guard.read_reference(ROOT / reference).outcomes
    scene_names = [block.scene_name(index) for block, index in guard.suite(int(scenes))]
    assert [outcome.scenario for outcome in outcomes] == scene_names
    assert [comparison.measure for comparison in guard.compare(outcomes, outcomes)] == list(guard.MEASURES)


def test_the_files_of_this_checkout_name_the_same_version():
    spec = importlib.util.spec_from_file_location("version", ROOT / ".ci" / "version.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.check(ROOT)
