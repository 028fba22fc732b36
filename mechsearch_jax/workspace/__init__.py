"""Where the search takes place: camera, shelf, target, scenario files."""
