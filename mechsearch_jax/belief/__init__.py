"""What is known of the target and the objects, and how a look changes it."""
