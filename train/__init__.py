"""Training of the networks, on scenes that are made and ray-cast on the accelerator as they are needed."""
