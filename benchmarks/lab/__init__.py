"""Our own evidence: how good the parts are, and the pages of the docs.

It runs in a checkout and is no part of the wheel; nothing outside of it imports it.
"""

PROGRAM = "python -m mechsearch_jax.benchmarks.lab"
