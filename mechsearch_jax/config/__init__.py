"""All settings of the planner, and the presets."""
