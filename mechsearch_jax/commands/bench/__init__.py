"""`mechsearch bench`: how long the parts take, how good they are, and what whole episodes come to."""

from mechsearch_jax.commands.bench import cells, episodes, looks, quality, timing

COMMANDS = {**timing.COMMANDS, **quality.COMMANDS, **looks.COMMANDS, **cells.COMMANDS, **episodes.COMMANDS}
