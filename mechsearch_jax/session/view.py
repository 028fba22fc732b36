"""What shows a search while it runs: a slot of the `Searcher`, which is filled from outside of the planner."""

from __future__ import annotations

from typing import Protocol

from mechsearch_jax.planner.trials import TriedActions
from mechsearch_jax.session.step import SearchStep


class View(Protocol):
    """Shows a search while it runs, such as `envs.viewer.live.LiveView`.

    It is called in the thread of the search, which goes on when the call returns; what takes long belongs into another
    thread. It changes nothing of the search.
    """

    def decided(self, step: SearchStep, tried: TriedActions) -> None:
        """Show a step.

        Args:
          step: what `next` is about to return.
          tried: what trials came to before that decision; nothing without trials.
        """
        ...

    def acted(self, step: SearchStep, ok: bool) -> None:
        """Show that the motion of a step is over.

        Args:
          step: the last one that was shown.
          ok: the argument of `acted`.
        """
        ...
