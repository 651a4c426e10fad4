"""Metadata of satellite scenes: rigorous sensors and rational polynomials as operators publish them."""
