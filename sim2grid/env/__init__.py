"""Missions in physics as an environment: choices in, observations and seconds out."""
