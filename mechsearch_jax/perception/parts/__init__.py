"""Segments explained by bodies of several superquadrics."""
