"""What actions do to objects."""
