"""Structure from motion: cameras and dense points from many images."""
