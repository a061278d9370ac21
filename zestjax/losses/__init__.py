"""Losses: unweighted scalar means, one module for each kind; `objective` is where they meet their weights."""
