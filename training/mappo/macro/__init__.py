"""MAPPO whose decisions are targets, held until something happens; no teacher."""
