"""From a point cloud to what networks see of it."""
