"""The search as a robot programmer runs it: an object that keeps the belief between images."""
