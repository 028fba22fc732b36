#!/usr/bin/env bash
# CoACD returns more convex hulls than max_convex_hull allows, without a word, where a mesh has parts that do not touch.
#
# coacd 1.0.14 (pip, Linux, Python 3.11). The mesh is closed and manifold: four boxes, 40 mm apart. `max_convex_hull` is
# "max # convex hulls in the result" (README of CoACD; merging, which it needs, is on by default).
# Expected: at most 2 hulls, or an error. Output of this script:
#   max_convex_hull=2: 4 hulls
# Whoever has room for so many hulls has to count them, and to join them himself.
#
# Exits with 1 if that has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet coacd==1.0.14 numpy==2.3.5
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import coacd
import numpy as np

corners = np.array([(x, y, z) for x in (0, 0.06) for y in (0, 0.06) for z in (0, 0.25)])
sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
box = np.array([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])
vertices = np.concatenate([corners + (0.1 * i, 0, 0) for i in range(4)])
faces = np.concatenate([box + 8 * i for i in range(4)])
coacd.set_log_level("error")
# The rest only makes it quick.
quick = {"resolution": 300, "mcts_iterations": 20, "mcts_max_depth": 2, "mcts_nodes": 10}
hulls = coacd.run_coacd(coacd.Mesh(vertices, faces), max_convex_hull=2, **quick)
print(f"max_convex_hull=2: {len(hulls)} hulls")
sys.exit(len(hulls) != 4)
PYTHON
