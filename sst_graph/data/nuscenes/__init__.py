"""Reader of nuScenes."""
