"""Feature matching between photos: epipolar checks of the poses, diagnosis of wrong ones, and triangulation."""
