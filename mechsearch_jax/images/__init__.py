"""Images of a camera and the points and pixels in them, before anything is recognised."""
