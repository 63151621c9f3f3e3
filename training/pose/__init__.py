"""Training of the network that estimates the pose of a cloth from one partial cloud."""
