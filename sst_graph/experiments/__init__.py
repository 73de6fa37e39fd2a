"""Experiments: tables of accuracy, made from seeds by one command each."""
