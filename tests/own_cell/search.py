"""One search: look, next, follow, acted, until the target is out; and all that is to be counted of it."""

import inspect
import json
import math
import os
import re
import time
import traceback

import numpy as np

from . import camera, execution, limits, setup, world

# A refusal is answered by so many further looks.
LOOKS = 3
# Contacts beyond this are counted [N], and what is acted on may be pressed on its board or stand with this.
TOUCH, PRESSED = 5.0, 15.0
# Results are "out" so close to the stand's place [m].
BESIDE = 0.04
# A search that does not end has failed.
MOST_MOTIONS = 24
# Motions that are no actions.
CLEARING = ("withdraw", "put-back")


def run(layout, seed, target, arm, folder, force=None, film=False):
    """Run the search of one layout and seed, and return its row, a dictionary of JSON values."""
    from mechsearch_jax.envs.cell.loading import load_searcher
    from mechsearch_jax.robot.trajectory_files import save_csv
    from mechsearch_jax.runtime.errors import InputError

    files = folder / "files" / f"{target}-{layout}-{seed}"
    files.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    try:
        (files / "cell.toml").write_text(setup.configuration(target, arm, obstacles=True))
        searcher = load_searcher(files / "cell.toml", seed=seed)
    except InputError as error:
        # A package that knows no obstacles cannot be told of them.
        if "obstacle" not in str(error):
            raise
        (files / "cell.toml").write_text(setup.configuration(target, arm))
        searcher = load_searcher(files / "cell.toml", seed=seed)
    cell, hand = world.World(world.drawn_layout(layout, target)), execution.Hand()
    execution.rest(cell, hand, 0.5)
    rng = np.random.default_rng([layout, seed, 7])
    row = {"layout": layout, "seed": seed, "target": target, "arm": arm, "retrieved": False, "why": "", "steps": []}
    frames, refused, motions, actions = [], 0, 0, 0
    masks = target == "cylinder"

    def end(why, retrieved=False):
        row.update(retrieved=retrieved, why=why, actions=actions, seconds=round(time.monotonic() - begun, 1))
        row["end"] = {n: [round(float(x), 3) for x in p[0]] for n, p in cell.poses().items()}
        if film and not retrieved:
            draw(frames, files / "film.png", f"layout {layout}, seed {seed}: {why}")
        return row

    while True:
        depth, colour, mask = camera.look(cell, rng)
        seen = {"target_pixels": int((mask == 0).sum()), "held": sorted(execution.held_things(cell))}
        started = time.monotonic()
        step, fault = None, ""
        try:
            given = {"mask": mask, "target_id": 0 if seen["target_pixels"] else -1} if masks else {}
            step = searcher.next(depth, colour, joints=cell.joints, width=cell.width, **given)
        except InputError as error:
            fault = str(error)
        note = {**seen, "seconds": round(time.monotonic() - started, 1), "width": round(cell.width, 4)}
        row["steps"].append(note)
        note.update(told(step, cell) if step else {"kind": "refused", "reason": fault})
        frames.append((colour, depth, f"{note['kind']}: {note['reason']}"))
        if step is None or step.trajectory is None:
            # Who reads that the hand may hold the target looks, and says so.
            if "acted(ok=True)" in note["reason"] and "target" in seen["held"]:
                searcher.acted(True)
                return end(taken_out(cell) or "the hand holds the target inside the shelf", bool(taken_out(cell)))
            refused += 1
            if refused > LOOKS:
                return end(f"refused: {note['reason']}")
            continue
        refused, motions, actions = 0, motions + 1, actions + (step.kind not in CLEARING)
        path = files / f"{motions:02d}.csv"
        save_csv(step.trajectory, path, overwrite=True)
        note["limits"], note["shares"] = limits.faults(path, arm, cell.joints)
        bounds = step.trajectory.bounds
        rows = limits.read_csv(path)[:3]
        note["duration"] = round(float(rows[0][-1]), 1)
        done = execution.follow(cell, hand, rows, step.trajectory.events, bounds.tracking, force or bounds.force)
        note["executed"] = {
            "ok": bool(done.ok),
            "stopped": done.stopped,
            "notes": done.notes,
            "gap": round(done.gap, 4),
            "grasps": done.grasps,
            "held": done.held,
            "lifted": done.lifted,
            "dropped": done.dropped,
            "moved": done.moved,
            "forces": {"|".join(pair): round(size, 1) for pair, size in done.forces.items() if size > 0.5},
        }
        note["unannounced"] = unannounced(note, done)
        told_joints = "joints" in inspect.signature(searcher.acted).parameters
        searcher.acted(done.ok, **({"joints": cell.joints} if done.stopped and told_joints else {}))
        if done.stopped and not told_joints:
            return end(f"{done.notes[-1]}, and the searcher cannot be told where it stands")
        if "target" in done.dropped:
            return end(f"the target was dropped: {done.dropped['target']}")
        out = taken_out(cell)
        if searcher.finished:
            return end(out or "the searcher takes the target to be out, which it is not", bool(out))
        if "target" not in done.held and cell.poses()["target"][0][0] < world.FRONT - 0.02:
            return end("the target is out, which the searcher does not know" if out else "the target fell out")
        if motions >= MOST_MOTIONS:
            return end(f"not out after {motions} motions")


def taken_out(cell):
    """Where the target is if it is outside, held or put down; empty if it is not."""
    place, turned = cell.poses()["target"]
    if "target" in execution.held_things(cell):
        return "held outside" if place[0] < world.FRONT - 0.05 else ""
    off = math.dist(place[:2], world.STAND[:2])
    stands = abs(execution.height_above(cell, "target")) < 0.01 and turned[2, 2] > 0.95
    return f"put down, {1000 * off:.0f} mm from its place" if off < BESIDE and stands else ""


def told(step, cell):
    """What a step says, with the true thing that each recognised object is, and how wrong its shape is."""
    values = step.to_json()
    poses = cell.poses()
    objects = []
    for found in values["objects"]:
        name = min(poses, key=lambda n: math.dist(poses[n][0][:2], found["position"][:2]))
        objects.append(
            {
                "slot": found["slot"],
                "is": name,
                "size": [round(2 * s, 3) for s in found["size"]],
                "off": round(math.dist(poses[name][0][:2], found["position"][:2]), 3),
                "confidence": found.get("confidence"),
            }
        )
    action, kind = values["action"], step.kind
    of = None
    if action:
        slots = {o["slot"]: o["is"] for o in objects}
        of = "target" if kind == "retrieve" else slots.get(action["object"], "target")
    if kind in CLEARING:
        of = next(iter(execution.held_things(cell)), None)
    cost, expected = values["cost"], values["least_cost"]
    moves = step.trajectory is not None and kind in ("push", "pick-and-place")
    target = values["target"]
    return {
        "kind": kind,
        "reason": step.reason,
        "warnings": list(step.warnings),
        "cost": cost,
        "expected": expected,
        "without_gain": bool(moves and cost is not None and expected is not None and expected >= cost),
        "of": of,
        "objects": objects,
        "target_found": target["found"],
        "target_pose": target["found_pose"],
        "target_true": [round(float(x), 3) for x in (*poses["target"][0][:2], _yaw(poses["target"][1]))],
        "motion": values["motion"],
    }


def _yaw(rotation):
    return math.atan2(rotation[1, 0], rotation[0, 0])


def unannounced(note, done):
    """Contacts of more than 5 N that no grasp or push is for, and of which neither reason nor warnings speak.

    What is grasped, pushed or put down may be pressed on what is below it with `PRESSED`: that is what the motion is
    for, but no shove.
    """
    text = " ".join([note["reason"], *note["warnings"]])
    slots = {o["slot"]: o["is"] for o in note["objects"]}
    named = {
        {"shelf": "shelf", "target": "target"}.get(what) or slots.get(int(number or -1))
        for part in re.findall(r"(?:brush|touch)\w*([^;.]*)", text)
        for what, number in re.findall(r"\b(?:the (shelf|target)|objects? (\d+))", part)
    }
    found = {}
    for (one, other), size in done.forces.items():
        acted_on = one == f"{note['of']} (held)"
        wanted = other == note["of"] and one in ("hand", *execution.FINGERS)
        carried = acted_on and other == note["of"]
        most = PRESSED if acted_on and other in execution.SUPPORTS else TOUCH
        if size > most and not wanted and not carried and other not in named:
            found[f"{one}|{other}"] = round(size, 1)
    return found


def draw(frames, path, title):
    """Colour and depth of every look with what was said, as one picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(frames), 2, figsize=(13, 4.1 * len(frames)), squeeze=False)
    for (colour, depth, text), (left, right) in zip(frames, axes, strict=True):
        left.imshow(colour)
        right.imshow(np.where(depth > 0, depth, np.nan), vmin=0.5, vmax=1.4)
        left.set_title("\n".join(text[i : i + 150] for i in range(0, len(text), 150)), fontsize=7, loc="left")
        left.axis("off")
        right.axis("off")
    figure.suptitle(title[:150], fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.3 / figure.get_figheight()))
    figure.savefig(path, dpi=70)
    plt.close(figure)


def on_one_core(count, workers):
    """Keep this process, and so all its threads, to a core of its own; one or two take what there is."""
    if workers <= 2:
        return
    with count.get_lock():
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[count.value % len(cores)]})
        count.value += 1


def row_file(folder, layout, seed, target, arm):
    """Where the row of a search is kept."""
    return folder / "rows" / f"{target}-{arm}-{layout}-{seed}.json"


def kept(layout, seed, target, arm, folder, force, film):
    """Run a search and keep its row; what came of it in a line. An error is a lost search with its reason."""
    try:
        row = run(layout, seed, target, arm, folder, force, film)
    except Exception as error:
        row = {"layout": layout, "seed": seed, "target": target, "arm": arm, "retrieved": False, "steps": []}
        row |= {"why": f"error: {type(error).__name__}: {error}", "trace": traceback.format_exc()}
    path = row_file(folder, layout, seed, target, arm)
    # At once or not at all.
    part = path.with_suffix(".part")
    part.write_text(json.dumps(row, default=float))
    part.replace(path)
    return f"{'retrieved' if row['retrieved'] else 'lost'}: {row['why']}"
