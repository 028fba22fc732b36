"""From images to superquadrics."""
