"""From images to superquadrics: recognition, its refinement and scores, and the path from a real camera."""
