"""`mechsearch bench`: how long the parts take, and whether whole episodes come to less than before."""

from mechsearch_jax.commands.bench import episodes, timing

COMMANDS = {**timing.COMMANDS, **episodes.COMMANDS}
