"""The search as a robot programmer runs it: an object that keeps what is known between images."""
