"""Where the shelf is in a depth image, against where camera and shelf are said to be."""
