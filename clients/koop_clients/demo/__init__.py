"""`python -m koop_clients.demo`: the whole of koop, once, in about a minute."""
