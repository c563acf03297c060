"""The engines that run several workers, and give each its shards."""
