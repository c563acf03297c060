"""`koop-sim-client`: a simulated plant that streams to the service, asks it, and obeys it."""
