"""Whether the planner grasps a target of any shape wherever physics says that it can be grasped."""
