"""How the service is: health, metrics, logs, memory, and a watchdog."""
