"""What does not change in an episode, and the workcell that it is built from."""
