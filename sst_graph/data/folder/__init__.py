"""Drives in a folder of images and clouds."""
