"""The Panda: geometry, kinematics, motions."""
