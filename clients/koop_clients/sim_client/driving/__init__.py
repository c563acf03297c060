"""Bringing poles to a target: by the service's commands, or by laws that know the true state."""
