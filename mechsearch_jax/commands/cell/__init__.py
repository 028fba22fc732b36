"""Commands about a cell: what is usable, what can be set, and where its camera is."""
