"""The existence function f: where can the target still be? (paper section 4.2 and appendix B.2;
docs/method.md, "Existence")

A candidate pose stands for its whole grid cell, so the target is tried at several places of the cell. At each it must
be hidden (it would show no more pixels than the detector needs) and free of collision. f is 1 if any of the places
passes. Shapes count as they are recognised, without margins.

Pixels are counted at a fraction of the camera's resolution, where a sliver beside an object may count for several times
its size. Where few pixels show, what is really seen is therefore counted again, more finely (`allowances`), and a place
at which the target is hidden after all may go on showing as many coarse pixels: predicted states are judged by the
coarse image alone.

A pose whose cell holds any hidden place has to stay possible, or the target is lost. In generated scenes f is 1.13
times as large as that least set (40 scenes, 25 places a cell at full resolution, `mechsearch bench scenes --exact`),
which is itself 1.63 times what the cells' middles alone make.
"""

from mechsearch_jax.existence.closer_look import allowances, closer_image, plainly_elsewhere
from mechsearch_jax.existence.config import ExistenceConfig
from mechsearch_jax.existence.function import existence
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
    "no_views",
    "object_views",
    "occluders",
    "plainly_elsewhere",
]
