"""Infrastructure of all parts of the package: compiled functions, files, versions, errors."""
