"""`mechsearch bench`: how long the parts take, what is recognised in real images, whether episodes come to less."""

from mechsearch_jax.commands.bench import episodes, real, timing

COMMANDS = {**timing.COMMANDS, **real.COMMANDS, **episodes.COMMANDS}
