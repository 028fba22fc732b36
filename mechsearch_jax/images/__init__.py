"""Camera images, their points and pixels, before recognition."""
