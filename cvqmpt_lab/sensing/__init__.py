"""From what a depth camera saw to a scene: files, poses of cameras, filters, the table that things stand on."""
