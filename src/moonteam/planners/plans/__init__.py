"""From routes to plans, followed and drawn."""
