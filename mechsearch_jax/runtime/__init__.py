"""What every part of the package runs on: compiled functions, files, versions, errors."""
