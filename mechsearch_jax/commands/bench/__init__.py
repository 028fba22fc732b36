"""`mechsearch bench`: how long the parts take, how good they are, and what whole episodes come to."""

from mechsearch_jax.commands.bench import cells, episodes, quality, timing

COMMANDS = {**timing.COMMANDS, **quality.COMMANDS, **cells.COMMANDS, **episodes.COMMANDS}
