"""The cores of the searches by the clock, compiled with Numba, and what they are given."""
