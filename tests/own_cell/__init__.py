"""A cell of one's own: shelf, camera, arm and hand in MuJoCo, to search in as a stranger to the package would.

Nothing here but `search` imports the package, and that only through what its docs name: a configuration file,
`load_searcher`, images in, trajectories and CSV files out. `python -m tests.own_cell --help` runs searches.
"""
