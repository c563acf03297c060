"""How the service is: health, gauges, memory, and a watchdog."""
