"""Alignment terms for a graph of your own."""
