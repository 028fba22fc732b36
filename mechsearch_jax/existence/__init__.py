"""The existence function f: where can the target still be? (paper section 4.2 and appendix B.2;
docs/method.md, "Existence")

A candidate pose represents its whole grid cell, so the target is tested at several places of the cell. At each it must
be hidden (it would show no more pixels than the detector needs) and free of collision. f is 1 if any place passes.
Recognised shapes are used without margins. A pixel in which nothing was measured shows nothing: it rules no place out.

Pixels are counted at a fraction of the camera's resolution, where a sliver beside an object may count for several times
its size. Where few pixels show, the observed scene is therefore counted again at a finer resolution (`allowances`). If
the target is hidden there, the place may keep showing as many coarse pixels, since predicted states are judged by the
coarse image alone.

A pose whose cell contains any hidden place must stay possible, or the target is lost. In generated scenes f is 1.13
times as large as that least set (40 scenes, 25 places a cell at full resolution, `python -m
mechsearch_jax.benchmarks.lab scenes --exact`), which is itself 1.63 times as large as with the cells' middles alone.
"""

from mechsearch_jax.existence.closer_look import allowances, closer_image, plainly_elsewhere
from mechsearch_jax.existence.config import ExistenceConfig
from mechsearch_jax.existence.function import existence, free, undetected
from mechsearch_jax.existence.tables import ExistenceTables, existence_tables
from mechsearch_jax.existence.views import ObjectViews, no_views, object_views, occluders

__all__ = [
    "ExistenceConfig",
    "ExistenceTables",
    "ObjectViews",
    "allowances",
    "closer_image",
    "existence",
    "existence_tables",
    "free",
    "no_views",
    "object_views",
    "occluders",
    "plainly_elsewhere",
    "undetected",
]
