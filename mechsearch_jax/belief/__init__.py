"""The belief about the target, and how an observation changes it."""
