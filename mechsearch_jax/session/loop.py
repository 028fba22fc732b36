"""The loop of a search on a robot: look, decide, move; where nothing can be done look again, and then ask a person."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, is_file

if TYPE_CHECKING:
    from mechsearch_jax.robot.robot_trajectory import RobotTrajectory
    from mechsearch_jax.session.searcher import Searcher
    from mechsearch_jax.session.step import SearchStep


def run_search(
    searcher: Searcher,
    look: Callable[[], Mapping[str, Any]],
    follow: Callable[[RobotTrajectory], bool],
    ask: Callable[[str], bool],
    *,
    confirm: Callable[[SearchStep], bool] = lambda step: True,
    tell: Callable[[str], None] = print,
    state: PathLike | None = None,
    looks: int = 3,
) -> bool:
    """Search until the target is taken out, or a person ends it.

    Images may be refused, or recognised too doubtfully to move, in one look and not in the next. So it looks again
    before it asks.

    Args:
      searcher: of the search; it may be in the middle of it.
      look: takes new images, and returns the arguments of `Searcher.next` by their names.
      follow: moves the robot, and returns whether that went well. Whatever it raises, the searcher is told that the
        motion failed.
      ask: called with the reason after every `looks` looks in a row without a motion; whether to look again. A person
        may meanwhile have mended what it says, or called `searcher.acted()` where the target is in the hand.
      confirm: whether a step's motion may be made; if not, the search ends.
      tell: called with each step's kind and reason, and with each of its warnings.
      state: file in which the search is kept after each step. One that is there is gone on with; a motion that had
        not ended counts as failed. Remove it to begin anew.
      looks: at least 1.

    Returns:
      Whether the target was taken out.

    Raises:
      InputError: the state's file cannot be used.
    """
    if state is not None and is_file(state):
        searcher.load(state)
        if searcher.moving:
            searcher.acted(ok=False)

    def keep() -> None:
        if state is not None:
            searcher.save(state)

    refused = 0
    while not searcher.finished:
        step, reason = None, ""
        try:
            step = searcher.next(**look())
        except InputError as error:
            reason = f"refused: {error}"
        if step is not None:
            reason = f"{step.kind}: {step.reason}"
        tell(reason)
        for warning in () if step is None else step.warnings:
            tell(f"warning: {warning}")
        if step is None or step.trajectory is None:
            refused += 1
            if refused % looks == 0:
                if not ask(reason):
                    return False
                keep()
            continue
        if not confirm(step):
            return False
        refused, ok = 0, False
        keep()
        try:
            ok = follow(step.trajectory)
        finally:
            searcher.acted(ok)
            keep()
    return True
