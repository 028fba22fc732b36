"""The workspace of the search: camera, shelf, target, scenario files."""
