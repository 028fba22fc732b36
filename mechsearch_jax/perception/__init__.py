"""From a depth image to superquadrics: point clouds, segments, recognition (paper section 4.1 and appendix B.1)."""
