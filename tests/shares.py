"""The parts of the slow tests, each of which takes about as long as another.

Tests of a file share what they compile, and stay together as long as they take less than half a part: two processes
work on a part. How long each takes in one process stands in slow_seconds.json. After new ones were written,

    pytest -n 0 -m 'slow and not gpu' --junitxml slow.xml && python tests/shares.py slow.xml

measures again and writes it. Tests that are not in it count as `UNKNOWN`.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

SECONDS = Path(__file__).parent / "slow_seconds.json"
UNKNOWN = 15.0


def measured(path=SECONDS):
    """Seconds of each test that was measured, by file and name with its parameters."""
    return json.loads(path.read_text())


def seconds_of(nodeid, seconds):
    """How long a test takes, in s."""
    path, _, name = nodeid.partition("::")
    return seconds.get(Path(path).stem, {}).get(name, UNKNOWN)


def bundles(nodeids, parts, seconds):
    """Lists of tests that stay together, in the order of the tests, with the seconds that each takes."""
    limit = sum(seconds_of(nodeid, seconds) for nodeid in nodeids) / (2 * parts)
    of_files = defaultdict(list)
    for nodeid in nodeids:
        of_files[nodeid.partition("::")[0]].append(nodeid)
    for tests in of_files.values():
        bundle, total = [], 0.0
        for nodeid in tests:
            more = seconds_of(nodeid, seconds)
            if bundle and total + more > limit:
                yield bundle, total
                bundle, total = [], 0.0
            bundle.append(nodeid)
            total += more
        yield bundle, total


def part_of_each(nodeids, parts, seconds=None):
    """To which of the parts, counted from 1, each slow test belongs.

    The bundle that takes longest goes first, each to the part that has least to do yet.
    """
    seconds = measured() if seconds is None else seconds
    loads = [0.0] * parts
    part_of = {}
    for bundle, total in sorted(bundles(nodeids, parts, seconds), key=lambda b: (-b[1], b[0][0])):
        part = min(range(parts), key=lambda k: (loads[k], k))
        loads[part] += total
        part_of.update(dict.fromkeys(bundle, part + 1))
    return part_of


def longest_first(nodeids):
    """The files of tests, by name, that which takes longest first."""
    seconds, of_files = measured(), defaultdict(float)
    for nodeid in nodeids:
        of_files[Path(nodeid.partition("::")[0]).stem] += seconds_of(nodeid, seconds)
    return sorted(of_files, key=lambda name: (-of_files[name], name))


def write(reports, path=SECONDS):
    """Writes how long the tests in reports of pytest in the form of JUnit took, in s, beside what else was measured."""
    seconds = measured(path)
    for report in reports:
        for case in ElementTree.parse(report).iter("testcase"):
            file = case.get("classname").rpartition(".")[2]
            seconds.setdefault(file, {})[case.get("name")] = round(float(case.get("time")), 1)
    path.write_text(json.dumps(seconds, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    write(sys.argv[1:])
