"""One file for each kind of action: what is proposed, what it does, how the robot moves, how it is drawn."""
