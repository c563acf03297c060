"""Which shards a worker owns, and the engines that run several workers."""
