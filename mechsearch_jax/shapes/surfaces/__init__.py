"""Triangle surfaces: mended where they are not closed, and how far others are from them."""
