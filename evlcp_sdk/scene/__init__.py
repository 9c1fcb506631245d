"""The world: camera, bar, sites, attitude."""
