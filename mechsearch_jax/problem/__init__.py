"""The constants of an episode, and the workcell from which they are computed."""
