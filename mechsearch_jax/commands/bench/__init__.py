"""`mechsearch bench`: how long the parts take, how good they are, and what whole episodes come to."""

from mechsearch_jax.commands.bench import cells, episodes, looks, quality, targets, timing

COMMANDS = {
    **timing.COMMANDS,
    **quality.COMMANDS,
    **looks.COMMANDS,
    **cells.COMMANDS,
    **targets.COMMANDS,
    **episodes.COMMANDS,
}
