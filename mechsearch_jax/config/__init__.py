"""Every setting of the planner, and the presets."""
