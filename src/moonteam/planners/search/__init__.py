"""The cores of the searches, compiled with Numba, and what they are given."""
