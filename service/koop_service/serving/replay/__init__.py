"""What the logs of sources have and a trajectory lacks: it is asked for, and folded first."""
