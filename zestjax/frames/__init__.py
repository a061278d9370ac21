"""Frames of a video: which serve a target, what each says of itself, what is known of them."""
