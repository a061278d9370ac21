"""Systems as values: parts, the presets made of them, and how they are trained."""
