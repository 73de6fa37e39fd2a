"""The simulated camera: pictures, masks as a network or a person would draw them, lenses."""
