"""Closed-loop control on the simulator, through Zenoh: success, cost and latency by method."""
