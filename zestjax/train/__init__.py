"""Teaching a system: what is known of a target, what is measured, one objective, recipes."""
